"""Computes with several calibrated views at once: points (section 4.2), the visual hull, epipolar tangencies, and the
upward direction.

In: rays or silhouettes and the rig. Out: points, volumes and distances in mm of the world frame.
"""
