"""Provides geometric primitives for meshes and points in mm in any common frame, with one implementation of each
primitive. This package contains nothing specific to heads.

Each fast function has a naive counterpart (``..._naive``) of a few simple lines; tests compare the results of both
functions."""
