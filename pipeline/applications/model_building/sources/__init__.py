"""Reads models of other sources: MakeHuman's population, other programs' files, downloads."""
