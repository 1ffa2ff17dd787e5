"""Describes checkerboards and ChArUco boards, prints them, and finds their corners in pictures."""
