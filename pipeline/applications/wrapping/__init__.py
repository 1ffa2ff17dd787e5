"""Wraps raw scans: represents the scan of one head in the vertex order of a template.

The input is a triangle mesh in any unit and orientation (``scan``), with or without colours, and a template with its
head model. The output is the template's vertices on the scan (in the scan's frame and unit), the remaining distances,
and a texture in the template's texture coordinates. The method is the paper's section 3.2 for a single scan, with
landmarks from a face detector."""
