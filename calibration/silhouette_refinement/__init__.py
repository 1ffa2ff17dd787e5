"""Cameras refined by the outlines of the heads they saw (Ramanathan, Steinbach and Girod 2000)."""
