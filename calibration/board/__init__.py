"""Checkerboards and ChArUco boards: what they are, how they print, where their corners lie in a picture."""
