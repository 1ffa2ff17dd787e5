"""Defines the values that all other packages share: cameras, pictures, transforms, meshes and messages.

The frame ``world`` belongs to the rig, ``camera`` to one camera, and ``head`` to the subject. A transform ``b_from_a``
converts coordinates in frame a to frame b. Lengths are in millimetres and angles in radians; a name states any other
unit (``_deg``, ``_px``, ``_s``).

In the camera frame x points right, y down and z forward, as in OpenCV. Pixel (0, 0) is the **centre** of the top-left
pixel. In the head frame x points to the subject's left, y up and z out of the face; the origin is inside the head.

Images in memory are RGB ``uint8 (H, W, 3)``, row 0 on top. Only file readers and writers handle BGR. Only
``rig.render.context`` handles OpenGL's row order from bottom to top.
"""
