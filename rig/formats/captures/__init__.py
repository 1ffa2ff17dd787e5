"""Reads and writes captures: folders and archives with the pictures of one synchronised shot, masks and feature points.

The input is a folder or an archive. The output is a ``Capture`` with its ``Rig``, or an error that lists all faults."""
