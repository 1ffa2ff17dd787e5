"""Writes a fitted head in the vertex order of a template."""
