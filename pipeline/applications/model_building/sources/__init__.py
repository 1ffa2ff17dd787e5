"""Reads head models from other sources: MakeHuman, other programs' files, downloads."""
