"""Which patches of the face lie under hair: its surface is not the head's, yet photographs see it sharply.

The part maps (``pipeline.part_labels.labelling``) say of every pixel how probably it shows hair; a patch is hair's
where most of what the views see of it is, and where it is about to be: its window reaches into the hair, which stands
off the skin."""

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

    Args:
        patches: samples of the face and patches of them.
        hair: probability that a pixel shows hair; cameras without a map are ignored.
        names: of the k cameras.
        pixel: where each camera sees each sample.
        seen: whether it does.
        centres: of the patches (mm).
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
    """Returns the mean over each patch's known samples; 0 where none is known."""
    total = patches.sums(patches.agreement, np.stack([values * known, known], axis=1).astype(float))
    return total[:, 0] / np.maximum(total[:, 1], 1e-9)
