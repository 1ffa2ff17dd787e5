"""Unfolds a mesh: where each triangle lies in a texture, in full and reduced, and the normals that these lose."""
