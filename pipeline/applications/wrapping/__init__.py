"""Wraps raw scans: gives a scan of one head the vertex order of a template.

In: a triangle mesh in any unit and orientation (``scan``), with or without colours, and a template with its head model.
Out: the template's vertices on the scan, in the scan's own frame and unit, the remaining distances, and a texture in
the template's layout. This is section 3.2 for one scan; the face finder supplies its landmarks.
"""
