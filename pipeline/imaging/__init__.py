"""Treats images as geometry: silhouettes and their distances, masks, colour charts, highlights."""
