"""Reads a head's pores from the full-size pictures.

Enters: the coloured head, its layout, a reader of the pictures at the size of their files. Leaves: a texture with their
detail, the relief of the skin (mm) and its normals, in the layout. The geometry stays as it is.
"""
