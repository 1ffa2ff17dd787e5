"""The face at a glance: which cameras lack it, and where it looks, of drawn heads in small pictures."""

from collections.abc import Mapping

import numpy as np
import pytest

from pipeline.faces.networks import FaceNetworks
from pipeline.faces.sighting import GLANCE, _turned, file_pixels, has_front, reduce_picture, sight_face
from pipeline.faces.subject import find_subject
from rig.acquisition.face_sighting import FaceSighting
from rig.camera import Camera, Intrinsics
from rig.geometry import RigidTransform, look_at
from rig.image import ImageRgb
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.drawn_studio import drawn_pictures, drawn_studio, hidden_from


def glance(pictures: Mapping[str, ImageRgb], networks: FaceNetworks, rig: Rig | None = None) -> FaceSighting:
    cameras = rig or drawn_studio()
    return sight_face(find_subject(pictures, cameras, networks, effort=GLANCE), cameras, front=cameras.names[0])


def test_where_a_face_looks_is_told_and_nobody_blames_a_camera_behind_the_head(networks: FaceNetworks) -> None:
    straight, aside, up = (glance(drawn_pictures(*turn), networks) for turn in ((0.0,), (25.0,), (0.0, 20.0)))
    assert straight.is_found
    assert straight.missing == aside.missing == ()
    assert straight.left_deg == pytest.approx(0.0, abs=4.0)
    assert straight.up_deg == pytest.approx(0.0, abs=6.0)  # a drawn head is no member of a population
    assert aside.left_deg == pytest.approx(25.0, abs=5.0)
    assert up.up_deg == pytest.approx((straight.up_deg or 0.0) + 20.0, abs=6.0)


def test_a_camera_that_should_show_the_face_and_does_not_is_named(networks: FaceNetworks) -> None:
    shown = hidden_from(("cam2", "cam4", "cam5"), drawn_pictures())  # cam4 stands 50 degrees aside
    assert glance(shown, networks).missing == ("cam2",)


def test_without_a_face_nobody_is_blamed_and_the_search_ends_early(networks: FaceNetworks) -> None:
    rig = default_layout().scaled(0.4)
    blank = {c.name: np.full((c.intrinsics.height, c.intrinsics.width, 3), 90, np.uint8) for c in rig}
    seen = glance(blank, networks, rig)
    assert (seen.searched, seen.is_found, seen.has_faces, seen.missing, seen.left_deg) == (5, False, False, (), None)


def test_a_ring_has_no_front() -> None:
    angles = np.radians(np.arange(0, 360, 30))
    lens = Intrinsics(480, 360, 675.0, 675.0, 239.5, 179.5)
    around = [1000.0 * np.array([np.sin(a), 0.2, np.cos(a)]) for a in angles]
    up = np.array([0.0, 1.0, 0.0])
    ring = Rig(tuple(Camera(f"cam{k:02}", lens, look_at(c, np.zeros(3), up)) for k, c in enumerate(around)))
    assert not has_front(ring)
    assert has_front(default_layout())


def test_pixels_go_back_to_the_files_picture_and_through_the_lens_of_an_undistorted_one() -> None:
    lens = Intrinsics(1600, 1200, 1500.0, 1500.0, 799.5, 599.5)
    camera = Camera("cam0", lens, RigidTransform(np.eye(3), np.zeros(3)))
    image, small = reduce_picture(np.zeros((1200, 1600, 3), np.uint8), camera, 640)
    assert image.shape == (480, 640, 3)
    point = np.array([[30.0, -20.0, 900.0], [-90.0, 60.0, 1000.0]])
    np.testing.assert_allclose(file_pixels(small.project(point), small, camera), camera.project(point), atol=1e-9)
    same, unchanged = reduce_picture(image, small, 640)
    assert (same is image, unchanged is small) == (True, True)
    lens, recorded = Intrinsics(1600, 1200, 900.0, 900.0, 799.5, 599.5), RecordedLens("kannala-brandt", (0.1, 0, 0, 0))
    camera = Camera("cam0", lens, RigidTransform(np.eye(3), np.zeros(3)), recorded=recorded)
    pixels = np.array([[700.0, 900.0], [1200.0, 100.0]])
    np.testing.assert_allclose(
        recorded.undistorted(file_pixels(pixels, camera, camera), lens.matrix()), pixels, atol=1e-6
    )


def test_who_looks_between_two_rows_is_turned_from_neither() -> None:
    assert _turned(-20.0, 1.0) == 0.0
    assert _turned(-20.0, -3.0) == 0.0
    assert _turned(25.0, 7.0) == 25.0
