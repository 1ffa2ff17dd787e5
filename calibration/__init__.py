"""A rig from pictures of a board, refined by silhouettes, and the checks on it."""
