"""Images as geometry: silhouettes and their distances, masks, projection in compiled loops, a rasteriser without GL."""
