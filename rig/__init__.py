"""Models the rig: its cameras and their pictures.

Frames. ``world`` is the frame of the rig, ``camera`` that of one camera, ``head`` that of the subject. ``b_from_a``
takes coordinates in frame a to frame b. Lengths are millimetres, angles radians; any other unit is in the name
(``_deg``, ``_px``, ``_s``).

Camera frame (OpenCV): x right, y down, z forward. Pixel (0, 0) is the **centre** of the top-left pixel.
Head frame: x to the subject's left, y up, z out of the face, origin inside the head. All frames are right-handed.

Images in memory are RGB ``uint8 (H, W, 3)``, row 0 on top. Only file readers and writers handle BGR, and only
``rig.render.context`` handles OpenGL's rows, which are counted from below.
"""
