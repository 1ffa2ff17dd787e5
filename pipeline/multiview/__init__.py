"""Measures what several calibrated views show together: points (section 4.2), the visual hull, epipolar tangencies, and
which way is up.

Enters: rays or silhouettes and the rig. Leaves: points, volumes and distances in mm of the world frame.
"""
