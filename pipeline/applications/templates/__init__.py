"""Writes fitted heads in the vertex order of another mesh, which is called the template. A template is registered to a
head model once, and then deforms with every head that is fitted with this model."""
