"""Finds which patches of the face lie under hair. Photographs show hair sharply, but its surface is not the head's.

The part maps (``pipeline.part_labels.labelling``) give the probability that a pixel shows hair. A patch counts as hair
if most of its pixels in the views do, and also if it is close to such a patch: its window then reaches into the hair,
which stands off the skin.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial import KDTree

from pipeline.photometric_fit.patches import Patches

HAIR_SHARE = 0.5  # of what the views see of a patch, from which on it is hair's
REACH_MM = 5.0  # a patch so near to hair still holds some of it: two windows

HairProbability = Mapping[str, Float32[np.ndarray, "_ _"]]  # by camera, on the photograph's own grid


def under_hair(
    patches: Patches,
    hair: HairProbability,
    names: Sequence[str],
    pixel: Float[np.ndarray, "k s 2"],
    seen: Bool[np.ndarray, "k s"],
    centres: Float[np.ndarray, "c 3"],
) -> Bool[np.ndarray, " c"]:
    """Tells which patches show hair or lie within ``REACH_MM`` of one that does.

    ``patches``: samples of the face and patches of them. ``hair``: probability that a pixel shows hair, by camera;
    cameras without a map are ignored. ``names``: of the k cameras. ``pixel``: the pixel at which each camera sees each
    sample. ``seen``: whether it sees the sample. ``centres``: of the patches, mm.
    """
    total, views = np.zeros(pixel.shape[1]), np.zeros(pixel.shape[1])
    for k, name in enumerate(names):
        if name in hair:
            column, row = np.rint(pixel[k, seen[k]]).astype(int).T
            total[seen[k]] += hair[name][row, column]
            views[seen[k]] += 1
    sure = patch_mean(patches, total / np.maximum(views, 1.0), views > 0) > HAIR_SHARE
    return KDTree(centres[sure]).query(centres)[0] < REACH_MM if sure.any() else sure


def patch_mean(
    patches: Patches, values: Float[np.ndarray, " s"], known: Bool[np.ndarray, " s"]
) -> Float[np.ndarray, " c"]:
    """Returns, for each patch, the mean of ``values`` over its samples that are ``known``; 0 if none is."""
    total = patches.sums(patches.agreement, np.stack([values * known, known], axis=1).astype(float))
    return total[:, 0] / np.maximum(total[:, 1], 1e-9)
