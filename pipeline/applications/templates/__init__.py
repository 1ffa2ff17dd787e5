"""Writes results in the vertex order of another mesh, a template. It is registered once to a head model, and from then
on deformed with every fitted head."""
