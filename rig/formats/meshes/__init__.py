"""Reads and writes meshes: PLY, OBJ, GLB, USDZ, and STL and 3MF for printers.

In: vertices in millimetres with colours, textures or morph targets. Out: bytes that are the same on every machine."""
