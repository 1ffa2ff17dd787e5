"""Simulates a photo studio with cameras, whose pictures tests and the demonstration use."""
