"""Reads and writes meshes in the formats PLY, OBJ, GLB, USDZ, STL and 3MF.

Writers take vertices in millimetres with colours, textures or morph targets, and give the same bytes everywhere."""
