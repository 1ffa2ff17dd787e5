"""Simulates a studio, which tests and the demo photograph."""
