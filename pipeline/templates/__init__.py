"""Results in the vertex order of somebody else's mesh: registered once to a head model, carried by it ever after."""
