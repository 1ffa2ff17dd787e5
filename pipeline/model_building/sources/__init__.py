"""Reads models from elsewhere: MakeHuman's population, other programs' files, downloads."""
