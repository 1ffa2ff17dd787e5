"""Judges whether a result is right, and whether it repeats. Meshes and landmarks enter, judgements leave, whatever
program made the heads."""
