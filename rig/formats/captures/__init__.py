"""Reads and writes captures: folders and archives of one synchronised shot, with masks, feature points and outlines.

In: a folder or an archive from any source. Out: a ``Capture`` with its ``Rig``, or all faults at once."""
