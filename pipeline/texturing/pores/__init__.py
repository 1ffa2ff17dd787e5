"""Estimates the skin's finest relief, such as pores, from the full-size pictures.

The modules take the coloured head, its UV layout and a function that reads full-size pictures. The modules return a
texture with the pictures' detail, the relief of the skin (mm) and a normal map. The mesh does not change.
"""
