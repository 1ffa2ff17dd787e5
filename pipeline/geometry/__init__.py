"""Provides geometric primitives, one implementation of each, for meshes and points in mm in any common frame. This
package knows nothing of heads.

Each fast function has a naive counterpart (``..._naive``) of a few obvious lines; tests compare the two.
"""
