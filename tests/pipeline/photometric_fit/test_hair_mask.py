"""Patches under hair, by planted probabilities."""

import numpy as np

from pipeline.photometric_fit.patches import Patches, under_hair


def row_of_patches(count: int) -> tuple[Patches, np.ndarray]:
    """One sample a patch, 3 mm apart along x."""
    each, ones = np.arange(count), np.ones(count)
    corners = np.repeat(each[:, None], 3, axis=1).astype(np.int32)
    patches = Patches(corners, np.full((count, 3), 1 / 3), each, np.arange(count + 1), each, np.zeros(count), ones)
    return patches, np.column_stack([3.0 * each, np.zeros((count, 2))])


def test_a_patch_is_hairs_where_most_views_say_so_and_next_to_it() -> None:
    patches, centres = row_of_patches(20)
    pixel = np.zeros((3, 20, 2))
    pixel[:, :, 0] = np.arange(20)
    seen = np.ones((3, 20), bool)
    seen[2, 10:] = False
    first, second = np.zeros((1, 20), np.float32), np.zeros((1, 20), np.float32)
    first[0, [3, 12]], second[0, [3, 12]] = 1.0, (0.8, 0.1)
    third = (np.arange(20) != 7)[None].astype(np.float32)  # calls all hair, and is outvoted, or does not see it
    third[0, :10] *= np.arange(10) == 3
    found = under_hair(patches, {"a": first, "b": second, "c": third}, ("a", "b", "c"), pixel, seen, centres)
    assert np.flatnonzero(found).tolist() == [2, 3, 4, 11, 12, 13]  # 0.55 at patch 12, and 5 mm about both


def test_without_maps_nothing_is_hair() -> None:
    patches, centres = row_of_patches(5)
    found = under_hair(patches, {}, ("a",), np.zeros((1, 5, 2)), np.ones((1, 5), bool), centres)
    assert not found.any()
