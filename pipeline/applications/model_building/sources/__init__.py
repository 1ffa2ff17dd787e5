"""Reads models from other sources: MakeHuman's population, other programs' files, downloads."""
