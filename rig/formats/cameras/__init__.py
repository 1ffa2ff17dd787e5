"""Reads and writes files of cameras: ``cameras.json``, other programs' files, and the length that gives them a scale.

Enters: a file, or a folder that holds one. Leaves: a checked ``Rig``, or all faults of the file at once.
``cameras_file`` picks the reader by the file's name; ``foreign_keys`` says what becomes of every key."""
