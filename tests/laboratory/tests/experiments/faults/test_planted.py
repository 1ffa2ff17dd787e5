"""What is planted in pictures is there, where it belongs, and nowhere else."""

import cv2
import numpy as np
import pytest

from rig.camera import Camera
from rig.capture import Capture
from rig.mesh import vertex_normals
from rig.studio.scene.visible import VisiblePoints
from tests.laboratory.experiments.faults.planted import HIT, OFF_PX, PLANTS, subject_mask
from tests.laboratory.experiments.paper.detail import Known
from tests.support.scenes import ellipsoid, fan, pixel_grid, ray_ellipsoid

pytestmark = pytest.mark.slow

WALL, SKIN = (40, 70, 120), (200, 150, 120)


@pytest.fixture(scope="module")
def known() -> Known:
    """A plain ellipsoid before a plain wall."""
    rig, head = fan(azimuths_deg=(-50, 0, 25, 50)), ellipsoid(4)
    points, normals = head.vertices.astype(np.float32), vertex_normals(head.vertices, head.faces).astype(np.float32)
    counts = np.zeros(len(points), np.uint8)
    images = {c.name: np.where(outline(c)[..., None], SKIN, WALL).astype(np.uint8) for c in rig}
    visible = VisiblePoints(points, normals, counts, counts + 2)
    return Known("ellipsoid", Capture(images), rig, head, head.vertices[:, 2] > 0.0, visible)


def outline(camera: Camera) -> np.ndarray:
    k = camera.intrinsics
    return np.isfinite(ray_ellipsoid(camera, pixel_grid(camera))).reshape(k.height, k.width)


def changed(known: Known, kind: str) -> dict[str, np.ndarray]:
    """Pixels of every view that are others than before."""
    spoilt = PLANTS[kind](known, np.random.default_rng(5)).capture.images
    return {name: (image != spoilt[name]).any(axis=2) for name, image in known.capture.images.items()}


def test_the_mask_that_plants_go_by_is_the_subject(known: Known) -> None:
    for camera in known.rig:
        mine, true = subject_mask(known, camera), outline(camera)
        grown = cv2.dilate(true.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
        assert mine[true].mean() > 0.99
        assert not (mine & ~grown).any()  # points are drawn two pixels wide


def test_strands_stand_off_the_head_in_every_view_and_leave_its_face(known: Known) -> None:
    for name, pixels in changed(known, "strands").items():
        head = outline(known.rig[name])
        assert pixels[~head].sum() > 100
        assert pixels[head].mean() < 0.05


@pytest.mark.parametrize(("kind", "before_face"), [("hand", True), ("behind", False)])
def test_one_camera_alone_sees_a_hand_before_the_face_or_somebody_behind(
    known: Known, kind: str, before_face: bool
) -> None:
    for name, pixels in changed(known, kind).items():
        head = outline(known.rig[name])
        if name != HIT:
            assert not pixels.any()
        else:
            assert pixels[~head].mean() > 0.02
            assert pixels[head].mean() > 0.05 if before_face else pixels[head].mean() < 0.04


def test_the_wrong_mask_lies_beside_the_subject(known: Known) -> None:
    masks = PLANTS["wrong-mask"](known, np.random.default_rng(5)).capture.masks
    assert set(masks) == {HIT}
    centre = [np.nonzero(mask)[1].mean() for mask in (masks[HIT], outline(known.rig[HIT]))]
    assert centre[0] - centre[1] > 5


def test_one_camera_is_turned_by_half_a_pixel(known: Known) -> None:
    spoilt = PLANTS["half-a-pixel-off"](known, np.random.default_rng(5)).rig
    for camera in known.rig:
        moved = spoilt[camera.name].project(known.mesh.vertices) - camera.project(known.mesh.vertices)
        off = np.linalg.norm(moved, axis=1)
        assert off.max() == 0.0 if camera.name != HIT else 0.9 * OFF_PX < off.mean() < 1.1 * OFF_PX
