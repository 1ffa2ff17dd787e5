"""Presents the simulated studio as devices: camera streams, a trigger box on a serial line, and files in a folder."""
