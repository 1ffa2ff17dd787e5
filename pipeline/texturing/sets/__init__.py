"""Colours a head by further photographs from the same cameras.

Enters: the head with the decision which photographs colour it, and the texture sets of the capture. Leaves: a texture
for each set, in the layout of the head's; and of sets in polarised light what the skin scatters (diffuse) and what its
surface mirrors (specular).
"""
