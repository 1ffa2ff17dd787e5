"""Computes UV layouts of the full mesh and of a mesh with fewer triangles, and a normal map with the detail lost by the
reduction."""
