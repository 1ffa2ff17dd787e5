"""Coefficients that are not the pictures', planted: pictures of spheres with a pattern, drawn by formula."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.multiview.scene_tracks import find_tracks, misses_px
from pipeline.view_checks.lens_distortion import judge_distortion
from rig.camera import Camera, Distortion
from rig.messages.message import Message
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.changed_rigs import relensed

RADIUS_MM = 130.0
PATTERN = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(700, 1400)).astype(np.float32), (0, 0), 2.5)
PATTERN = (255 * (PATTERN - PATTERN.min()) / np.ptp(PATTERN)).astype(np.float32)
NAMES = ("cam00", "cam01", "cam03", "cam05", "cam06")


def lensed(rig: Rig, k1: float) -> Rig:
    return relensed(rig, lambda intrinsics: replace(intrinsics, distortion=Distortion(k1=k1)))


def drawn(camera: Camera, centre: np.ndarray) -> tuple[np.ndarray, Silhouette]:
    """A sphere about ``centre`` with a pattern by longitude and latitude."""
    k = camera.intrinsics
    pixels = np.stack(np.meshgrid(np.arange(k.width), np.arange(k.height)), axis=-1).reshape(-1, 2).astype(float)
    straight = cv2.undistortPoints(pixels, k.matrix(), k.distortion.opencv()).reshape(-1, 2)  # faster than exact
    rays = np.insert(straight, 2, 1.0, axis=1) @ camera.camera_from_world.rotation
    rays, base = rays / np.linalg.norm(rays, axis=1, keepdims=True), camera.centre_world - centre
    along = rays @ base
    inside = along**2 - base @ base + RADIUS_MM**2
    normal = (base + (-along - np.sqrt(np.maximum(inside, 0.0)))[:, None] * rays) / RADIUS_MM
    column = (np.arctan2(normal[:, 0], normal[:, 2]) / np.pi + 1.0) * 699.0
    row = (np.arcsin(np.clip(normal[:, 1], -1, 1)) / np.pi + 0.5) * 699.0
    columns, rows = (part.reshape(k.height, k.width).astype(np.float32) for part in (column, row))
    mask = (inside > 0).reshape(k.height, k.width)
    shade = np.where(mask, cv2.remap(PATTERN, columns, rows, cv2.INTER_LINEAR), 40.0)
    return np.repeat(shade[..., None], 3, axis=2).astype(np.uint8), silhouette_from_mask(mask)


@pytest.fixture(scope="module")
def shots() -> dict[float, tuple[Rig, dict[str, np.ndarray], dict[str, Silhouette]]]:
    rig = default_layout().scaled(0.5).subset(NAMES)
    shots = {}
    for k1 in (0.0, -0.3):
        taken = lensed(rig, k1)
        pictures = {camera.name: drawn(camera, rig.centre_world()) for camera in taken}
        shots[k1] = taken, {n: i for n, (i, _) in pictures.items()}, {n: s for n, (_, s) in pictures.items()}
    return shots


@pytest.mark.parametrize("names", [NAMES, NAMES[:3]])  # of three views, points of two tell
@pytest.mark.parametrize(
    ("taken", "written", "finding"),
    [(0.0, 0.0, None), (-0.3, -0.3, None), (0.0, -0.3, "pictures-undistorted"), (-0.3, 0.0, "pictures-distorted")],
)
def test_coefficients_that_are_not_the_pictures_are_named(
    shots, taken: float, written: float, finding: str | None, names: tuple[str, ...]
) -> None:
    rig, images, silhouettes = shots[taken]
    found = judge_distortion(images, silhouettes, lensed(rig, written).subset(names))
    codes = [inner.code for warning in found if isinstance(inner := warning.parameters["finding"], Message)]
    assert codes == ([finding] if finding else [])
    assert [warning.code for warning in found] == ["lens-doubtful"] * len(codes)


@pytest.mark.parametrize("counted_from", [1.0, 0.0, -1.0])
def test_principal_points_that_count_from_one_are_named(shots, counted_from: float) -> None:
    """The bias of keypoints is below a tenth of a pixel; a quarter is what OpenCV has by itself."""
    rig, images, silhouettes = shots[-0.3]
    written = relensed(rig, lambda k: replace(k, cx=k.cx + counted_from, cy=k.cy + counted_from))
    found = [warning.parameters["finding"] for warning in judge_distortion(images, silhouettes, written)]
    assert len(found) == (counted_from != 0.0)
    for finding in found:
        assert isinstance(finding, Message)
        assert finding.code == "principal-points-counted"
        assert finding.parameters["shift_px"] == pytest.approx(counted_from, abs=0.1)


def test_rays_of_right_cameras_miss_by_a_fraction_of_a_pixel(shots) -> None:
    rig, images, silhouettes = shots[-0.3]
    tracks = find_tracks(images, silhouettes, rig)
    assert tracks.count > 100
    assert np.median(np.linalg.norm(misses_px(tracks, rig), axis=1)) < 0.5
    assert np.bincount(tracks.points).min() >= 3


def test_a_subject_without_detail_says_nothing(shots) -> None:
    rig, images, silhouettes = shots[0.0]
    flat = {name: np.full_like(image, 90) for name, image in images.items()}
    assert find_tracks(flat, silhouettes, rig).count == 0
    assert judge_distortion(flat, silhouettes, lensed(rig, -0.3)) == []
