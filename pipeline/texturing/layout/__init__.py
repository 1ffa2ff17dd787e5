"""Lays a mesh flat for its texture: the position of each triangle, on the full and on a reduced mesh, and the normals
lost by the reduction."""
