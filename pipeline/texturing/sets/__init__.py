"""Paints further textures of a head from further photographs by the same cameras, for example in polarised light.

The modules take the head, the views chosen for each vertex, and the capture's further sets of photographs. The modules
return a texture for each set. Sets in polarised light also give the diffuse and the specular reflection of the skin.
"""
