"""Reads and writes files of rigs, captures, pictures and meshes, in this project's formats and in other programs'.

Every reader reports all faults of a file at once; every writer renames a finished file into place."""
