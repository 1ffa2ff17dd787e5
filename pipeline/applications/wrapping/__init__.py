"""Wraps raw scans: gives a scan of one head the vertex order of a template.

Enters: a triangle mesh in any unit and orientation (``scan``), with colours or without, and a template with its head
model. Leaves: the template's vertices on the scan, in the scan's own frame and unit, what is left between the two, and
a texture in the template's layout. It is section 3.2 for one scan, whose landmarks the face finder supplies.
"""
