"""Reads and writes files of cameras: ``cameras.json``, other programs' files, and ``scale.json`` with a known length.

In: a file, or a folder that contains one. Out: a checked ``Rig``, or all faults of the file at once. ``cameras_file``
chooses the reader by the file's name; ``foreign_keys`` defines the treatment of every key."""
