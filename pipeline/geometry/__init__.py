"""Geometric primitives, one of each: meshes and points in mm in whatever frame they come; knows nothing of heads.

Beside each fast one stands a naive one (``..._naive``), a few lines that are plainly right: the tests hold the fast one
to it.
"""
