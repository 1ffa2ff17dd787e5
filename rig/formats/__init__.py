"""Reads and writes files of rigs, captures, pictures and meshes, in this project's formats and those of other programs.

Every reader reports all faults of a file at once. Every writer writes a temporary file first and then renames it."""
