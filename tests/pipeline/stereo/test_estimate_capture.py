"""The dense stage's depth on a capture rendered by another program, against the points that two cameras see."""

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.stereo.depth_map import DepthMap, points_world
from pipeline.stereo.estimate import estimate_depth
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from tests.support.noisy_captures import noisier
from tests.support.shared_data import shared

HEAD, HAIR = 0, 1


@pytest.mark.slow
def test_depth_of_a_scan_is_precise_and_states_its_deviation() -> None:
    """From true masks and without a fitted head: the search is bounded by the silhouettes alone."""
    folder, truth = shared("data/captures/scan-a"), shared("data/captures/scan-a.truth")
    capture, rig = read_capture(folder)
    masks = {name: cv2.imread(str(truth / "silhouettes" / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for name in rig.names}
    silhouettes = {name: silhouette_from_mask(mask > 127) for name, mask in masks.items() if mask is not None}
    maps = estimate_depth(capture.images, silhouettes, rig, None, report=lambda stage, share: None)
    visible = np.load(truth / "visible.npz")
    distance, deviations, part = errors(maps, visible)
    for which, precise, within_two in ((HEAD, 0.98, 0.9), (HAIR, 0.95, 0.8)):
        kind = part == which
        assert np.mean(distance[kind] < 2.0) > precise
        assert np.median(distance[kind]) < 0.25
        assert np.mean(deviations[kind] < 2.0) > within_two


@pytest.mark.slow
def test_smooth_skin_leaves_no_chance_matches() -> None:
    """An oily, path-traced head as it was photographed, highlights and all: what is told of it lies on the surface, and
    much is told. With chance matches left in, 93.5 % and 72.3 %; without those that the surface encloses 94.1 % and
    75.0 %, and searched twice 93.8 % and 75.5 %: of 1,000 pixels 708 are told and true for 706. (Without those at
    outlines and beside each other 94.8 % and 75.4 %, and 6 % of draw-b's clothes went.)"""
    precise, known_share = smooth_skin(1.0, 0.0)
    assert precise > 0.9355  # 93.6 % on a processor whose sums round otherwise, with the same code that gave 93.8 %
    assert known_share > 0.75
    assert precise * known_share > 0.706


@pytest.mark.slow
def test_small_noisy_photographs_are_searched_at_the_size_that_skin_needs() -> None:
    """The same at 512 x 384 with noise of 6 levels: 89.1 %, searched at a quarter of that size 87.3 %."""
    precise, known_share = smooth_skin(0.5, 6.0)
    assert precise > 0.882
    assert known_share > 0.43


def smooth_skin(factor: float, noise_levels: float) -> tuple[float, float]:
    """Returns the share of what is told of scan-a-skin's head that is true to 2 mm, and that of the subject's pixels
    which are told: from its photographs reduced, and with noise added."""
    folder, truth = shared("data/captures/scan-a-skin"), shared("data/captures/scan-a-skin.truth")
    capture, rig = read_capture(folder)

    def reduced(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1.0 else image

    shot = noisier(Capture({name: reduced(image) for name, image in capture.images.items()}), noise_levels)
    masks = {name: cv2.imread(str(truth / "silhouettes" / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for name in rig.names}
    silhouettes = {name: silhouette_from_mask(reduced(mask) > 127) for name, mask in masks.items() if mask is not None}
    small = rig.scaled(factor)
    maps = estimate_depth(shot.images, silhouettes, small, None, report=lambda stage, share: None)
    distance, _, part = errors(maps, np.load(truth / "visible.npz"))
    names = [each.camera.name for each in maps]
    scales = [each.camera.intrinsics.fx / small[each.camera.name].intrinsics.fx for each in maps]
    shown = sum(scale**2 * silhouettes[name].mask.sum() for name, scale in zip(names, scales, strict=True))
    return float(np.mean(distance[part == HEAD] < 2.0)), sum(int(each.known.sum()) for each in maps) / shown


def errors(
    maps: tuple[DepthMap, ...], visible: dict[str, np.ndarray], count: int = 40_000
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the true surface (mm), the same along the ray by the stated deviation, and the part, of ``count`` of
    the known pixels."""
    points = np.concatenate([points_world(each) for each in maps])
    stated = np.concatenate([each.deviation_mm[each.known] for each in maps])
    eyes = np.concatenate([np.tile(each.camera.centre_world, (int(each.known.sum()), 1)) for each in maps])
    chosen = np.random.default_rng(0).choice(len(points), count, replace=False)
    away, near = KDTree(visible["points"]).query(points[chosen])
    normal = visible["normals"][near]
    off = np.abs(((points[chosen] - visible["points"][near]) * normal).sum(axis=1))
    distance = np.where(away**2 - off**2 < 4.0, off, away)  # truth is 1.5 mm apart: beside a point its plane goes on
    ray = points[chosen] - eyes[chosen]
    upright = np.abs((ray * normal).sum(axis=1)) / np.linalg.norm(ray, axis=1)
    return distance, distance / np.maximum(upright, 0.15) / stated[chosen], visible["part"][near]
