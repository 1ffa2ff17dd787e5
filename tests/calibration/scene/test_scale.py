"""A known length makes millimetres of a structure of unknown unit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.scene.photographs import Photographs, find_photographs
from calibration.scene.scale import (
    ASSUMED,
    FACE_SHARE,
    find_scale,
    find_tags,
    scale_from_face,
    scale_from_head,
    scale_from_tags,
    times,
)
from calibration.scene.scene import transformed
from calibration.scene.structure import Structure
from rig.errors import InputError
from rig.formats.cameras.scale_json import CameraDistance, PointDistance, TagSize
from rig.formats.pictures.images import write_image
from tests.support.drawn_studio import drawn_pictures, drawn_studio
from tests.support.textured_wedge import TAG_MM, TAG_NUMBER, wedge_rig, write_photographs

UNIT = 0.0125  # of the structure in mm: what must come back is its inverse
HEAD = np.random.default_rng(0).normal(size=(500, 3)) * 60.0


def structure(points: np.ndarray) -> Structure:
    rig = wedge_rig()
    seen = np.concatenate([camera.project(points) for camera in rig])
    order = np.arange(len(points))
    whole = Structure(rig, points, np.repeat(np.arange(len(rig)), len(points)), np.tile(order, len(rig)), seen, True)
    return transformed(whole, rig, UNIT)


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
