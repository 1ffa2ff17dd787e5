"""Reads and writes captures: folders and archives with the pictures of one synchronised shot, masks and feature points.

A reader takes a folder or an archive, and returns a ``Capture`` with its ``Rig``, or an error that lists all faults."""
