"""Determines the head's pose (section 4.2).

In: feature points in the images, or silhouettes alone, and the mean head. Out: ``world_from_head``, the similarity from
which the fit starts.
"""
