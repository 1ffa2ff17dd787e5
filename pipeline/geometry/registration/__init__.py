"""Registers surfaces to each other, by rigid motions and similarities (``rigid``) or by smooth non-rigid deformation
(``nonrigid``). Module ``rigid`` can also estimate shape coefficients and search from many starts. Lengths are in mm.

The caller defines correspondences, their weights, and when a result is rejected."""
