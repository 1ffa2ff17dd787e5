"""Determines the head's pose (the paper's section 4.2).

The input is feature points in the images, or silhouettes alone, and the mean head. The output is ``world_from_head``,
the similarity from which the fit starts."""
