"""Cameras from photographs of a scene alone: no board, no clean plates."""
