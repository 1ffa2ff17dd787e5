"""The studio as devices: camera streams, a trigger box on a serial line, files in a folder."""
