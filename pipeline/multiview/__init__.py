"""What several calibrated views say together: triangulated points (section 4.2), visual hull, epipolar tangencies,
cameras
that have moved.
"""
