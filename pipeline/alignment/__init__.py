"""Determines where the head stands (section 4.2).

Enters: feature points in the images, or silhouettes alone, and the mean head. Leaves: ``world_from_head``, the
similarity from which the fit starts.
"""
