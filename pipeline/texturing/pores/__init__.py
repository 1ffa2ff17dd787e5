"""Reads the pores of the skin from the full-size pictures.

In: the coloured head, its layout, a reader of full-size pictures. Out: a texture with their detail, the relief of the
skin (mm) and its normals, in the layout. The mesh does not change.
"""
