"""Writes results in the vertex order of another mesh, the template. A template is registered to a head model once, and
then deforms with every fitted head."""
