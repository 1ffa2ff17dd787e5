"""Calibrates cameras from photographs of a scene alone, without board or clean plates."""
