"""Colours a head with further photographs from the same cameras.

In: the head with its decision about views, and the capture's texture sets. Out: a texture for each set, in the head's
layout. Sets in polarised light also give the light that the skin scatters (diffuse) and the light that its surface
mirrors (specular).
"""
