"""Measures images: silhouettes and distances to their contours, masks, colour charts, highlights."""
