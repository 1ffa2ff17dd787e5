"""Lays a mesh flat for its texture: where each triangle lies, on the full and on a reduced mesh, and the normals that
reduction loses."""
