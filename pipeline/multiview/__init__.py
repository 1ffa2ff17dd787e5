"""Measures what several calibrated views show together: points (section 4.2), visual hull, tangencies, the upright.

Enters: rays or silhouettes and the rig. Leaves: points, volumes and distances in mm of the world frame.
"""
