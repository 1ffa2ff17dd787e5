"""A known length makes millimetres of a structure, or of a rig, of unknown unit."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.scene.photographs import Photographs, find_photographs
from calibration.scene.scale import (
    ASSUMED,
    FACE_SHARE,
    find_scale,
    find_tags,
    scale_by_length,
    scale_from_face,
    scale_from_head,
    scale_from_tags,
    times,
)
from calibration.scene.scene import transform_structure
from calibration.scene.structure import Structure
from rig.camera import Camera
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.scale_json import CameraDistance, PointDistance, TagSize
from rig.formats.pictures.images import write_image
from rig.plausibility import rig_faults
from rig.studio.scene.layout import default_layout
from tests.support.drawn_studio import drawn_pictures, drawn_studio
from tests.support.textured_wedge import TAG_MM, TAG_NUMBER, wedge_rig, write_photographs

UNIT = 0.0125  # of the structure in mm: what must come back is its inverse
HEAD = np.random.default_rng(0).normal(size=(500, 3)) * 60.0


def structure(points: np.ndarray) -> Structure:
    rig = wedge_rig()
    seen = np.concatenate([camera.project(points) for camera in rig])
    order = np.arange(len(points))
    whole = Structure(rig, points, np.repeat(np.arange(len(rig)), len(points)), np.tile(order, len(rig)), seen, True)
    return transform_structure(whole, rig, UNIT)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    return write_photographs(tmp_path, wedge_rig().subset(["cam00", "cam01", "cam02"]))


ENDS = np.array([[-30.0, 10.0, -18.0], [32.0, 14.0, -19.2]])


def picked(which: int) -> dict[str, np.ndarray]:
    return {name: wedge_rig()[name].project(ENDS[which : which + 1])[0] for name in ("cam00", "cam02", "cam04")}


def test_two_points_two_cameras_and_a_printed_tag(photographs: Path) -> None:
    known = PointDistance(picked(0), picked(1), float(np.linalg.norm(ENDS[1] - ENDS[0])))
    found = find_scale(structure(ENDS), known, find_photographs(photographs), HEAD)
    assert found.factor == pytest.approx(1 / UNIT, rel=1e-6)
    assert (found.source, found.assumed) == ("points", False)
    assert 0.001 < found.share < 0.05  # a pixel is 0.9 mm here, of 62
    rig = wedge_rig()
    apart = float(np.linalg.norm(rig["cam00"].centre_world - rig["cam04"].centre_world))
    between = CameraDistance(("cam00", "cam04"), apart)
    found = find_scale(structure(ENDS), between, find_photographs(photographs), HEAD)
    assert found.factor == pytest.approx(1 / UNIT, rel=1e-9)
    found = find_scale(structure(ENDS), TagSize("DICT_4X4_50", TAG_MM), find_photographs(photographs), HEAD)
    assert found.factor == pytest.approx(1 / UNIT, rel=0.01)  # 12 corners to 0.3 px, of sides of 35 px
    assert f"({TAG_NUMBER})" in found.provenance.text


def test_tags_that_are_not_there_are_told(photographs: Path) -> None:
    with pytest.raises(InputError, match="no tag of it was found"):
        find_scale(structure(ENDS), TagSize("DICT_6X6_50", 40.0), find_photographs(photographs), HEAD)
    known = TagSize("DICT_4X4_50", TAG_MM)
    tags = find_tags(find_photographs(photographs), known)
    with pytest.raises(InputError, match="found in cam00, cam01, cam02"):
        scale_from_tags(wedge_rig().subset(["cam00", "cam03"]), known, tags)


def test_cameras_and_points_that_did_not_join_are_named(photographs: Path) -> None:
    whole = structure(ENDS)
    few = replace(whole, rig=whole.rig.subset(["cam00", "cam01", "cam02"]))
    with pytest.raises(InputError, match="cameras: cam04 did not join"):
        find_scale(few, CameraDistance(("cam00", "cam04"), 100.0), find_photographs(photographs), HEAD)
    lost = {name: pixel for name, pixel in picked(0).items() if name != "cam00"}
    with pytest.raises(InputError, match=r"points: the first .*cam04 did not join"):
        find_scale(few, PointDistance(lost, picked(1), 60.0), find_photographs(photographs), HEAD)


def test_a_heads_size_is_an_assumption() -> None:
    """Points like the head's own give its size whatever the unit; stray points far off do not matter."""
    points = np.concatenate([HEAD * 0.5, np.random.default_rng(1).normal(size=(200, 3)) * 4000.0])
    found = scale_from_head(structure(points), HEAD)
    # The sphere that all cameras see whole has 120 mm: of a cloud of sigma 30 mm hardly a point is cut off.
    assert found.factor == pytest.approx(2 / UNIT, rel=0.05)
    assert found.source in ASSUMED
    assert found.assumed
    assert "ASSUMPTION" in found.provenance.text


def test_a_face_in_the_photographs_gives_the_scale_of_an_adult(tmp_path: Path) -> None:
    for name, picture in drawn_pictures().items():
        write_image(tmp_path / f"{name}.png", picture)
    shots = Photographs({name: {"shot": tmp_path / f"{name}.png"} for name in drawn_studio().names})
    found = scale_from_face(times(drawn_studio(), UNIT), shots)
    assert found is not None
    assert found.factor == pytest.approx(1 / UNIT, rel=2 * FACE_SHARE)
    assert found.assumed
    assert scale_from_face(times(drawn_studio().subset(["cam4", "cam5"]), UNIT), shots) is None


RIG = default_layout()
BLANK = Capture({name: np.zeros((8, 8, 3), np.uint8) for name in RIG.names})
PLACES = np.array([[-31.0, 20.0, 80.0], [31.0, 22.0, 79.0]])
DISTANCE = float(np.linalg.norm(PLACES[1] - PLACES[0]))


def points() -> PointDistance:
    first, second = ({camera.name: camera.project(end[None])[0] for camera in RIG.cameras[:4]} for end in PLACES)
    return PointDistance(first, second, DISTANCE)


def cameras() -> CameraDistance:
    one, two = RIG.cameras[0], RIG.cameras[3]
    return CameraDistance((one.name, two.name), float(np.linalg.norm(one.centre_world - two.centre_world)))


def tagged(camera: Camera, side_mm: float) -> np.ndarray:
    """A tag before the camera, seen through its lens."""
    flat = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 3, 240)
    flat = np.pad(flat, 60, constant_values=255)
    corners = 0.5 * side_mm * 1.5 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) + (0, 0, 60)
    pixels = camera.project(corners).astype(np.float32)
    source = np.array([[-0.5, -0.5], [359.5, -0.5], [359.5, 359.5], [-0.5, 359.5]], np.float32)
    way = cv2.getPerspectiveTransform(source, pixels)
    seen = cv2.warpPerspective(flat, way, (camera.intrinsics.width, camera.intrinsics.height), flags=cv2.INTER_AREA,
                               borderValue=128)  # fmt: skip
    return cv2.merge([cv2.GaussianBlur(seen, (0, 0), 0.7)] * 3)


@pytest.mark.parametrize("factor", [0.01, 0.3, 3.3])
@pytest.mark.parametrize("known", [points(), cameras()], ids=["points", "cameras"])
def test_the_length_makes_the_rig_millimetres(factor: float, known: PointDistance | CameraDistance) -> None:
    free = times(RIG, factor)
    assert factor != 0.01 or rig_faults(free)
    assert not rig_faults(free, any_unit=True)
    scaled, (remark,) = scale_by_length(BLANK, free, free, known)
    assert remark.code == "cameras-scaled"
    for camera, true in zip(scaled, RIG, strict=True):
        np.testing.assert_allclose(camera.centre_world, true.centre_world, rtol=1e-3, atol=1e-3)
    assert not rig_faults(scaled)


def test_a_printed_tag_does() -> None:
    free = times(RIG, 2.0)
    views = Capture({camera.name: tagged(camera, 40.0) for camera in RIG.cameras[:4]})
    scaled, remarks = scale_by_length(views, free, free, TagSize("DICT_4X4_50", 40.0))
    assert len(remarks) == 1
    ratio = np.linalg.norm(scaled.cameras[0].centre_world) / np.linalg.norm(RIG.cameras[0].centre_world)
    assert ratio == pytest.approx(1.0, abs=0.01)
    with pytest.raises(InputError, match="no tag of it was found"):
        scale_by_length(views, free, free, TagSize("DICT_5X5_50", 40.0))


def test_cameras_that_agree_with_the_length_stay_and_covariances_grow_with_the_rig() -> None:
    near = times(RIG, 1.001)
    same, remarks = scale_by_length(BLANK, near, near, cameras())
    assert (same.cameras, remarks) == (near.cameras, [])
    camera = RIG.cameras[0]
    before = np.diag([1e-6, 1e-6, 1e-6, 0.1, 0.1, 0.1])
    (after,) = times(type(RIG)((Camera(camera.name, camera.intrinsics, camera.camera_from_world, before),)), 2.0)
    assert after.covariance is not None
    np.testing.assert_allclose(np.diag(after.covariance), [1e-6, 1e-6, 1e-6, 0.4, 0.4, 0.4])
