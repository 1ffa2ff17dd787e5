"""Reads and writes meshes: PLY, OBJ, GLB, USDZ, and STL and 3MF for printers.

Enters: vertices in millimetres with colours, textures or morph targets. Leaves: bytes that are the same on every
machine."""
