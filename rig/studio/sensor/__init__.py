"""Simulates a camera's lens and sensor, which convert the light of a scene to a picture, and deliberate faults."""
