"""Measures images: silhouettes and distances to them, masks, colour charts, highlights."""
