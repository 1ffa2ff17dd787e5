"""Provides geometric primitives, one implementation of each: meshes and points in mm, in any common frame. Nothing here
knows of heads.

Beside each fast function there is a naive one (``..._naive``), a few lines that are plainly right; tests compare the
two.
"""
