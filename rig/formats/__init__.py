"""Reads and writes files of rigs, captures, pictures and meshes, our own formats and other programs'.

Every reader reports all faults of a file at once; every writer renames a finished file into place."""
