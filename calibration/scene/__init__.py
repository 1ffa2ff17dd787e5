"""Calibrates cameras from photographs of a scene, without a calibration board."""
