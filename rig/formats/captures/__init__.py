"""Reads and writes captures: folders and archives of one synchronised shot, with masks, feature points and outlines.

Enters: a folder or an archive that anybody may have made. Leaves: a ``Capture`` with its ``Rig``, or all faults at
once."""
