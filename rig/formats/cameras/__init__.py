"""Reads and writes files of cameras: ``cameras.json``, files of other programs, and ``scale.json`` with a known length.

A reader returns a checked ``Rig``, or reports all faults of a file. The module ``cameras_file`` chooses the reader by
the file's name. ``foreign_keys`` defines how readers treat every key of another program's file."""
