"""Writes a result in the vertex order of a template."""
