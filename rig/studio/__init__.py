"""The simulated studio, which the tests and the demo photograph."""
