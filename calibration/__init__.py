"""Calibrates a rig from pictures of a board, refines it by silhouettes, and checks it."""
