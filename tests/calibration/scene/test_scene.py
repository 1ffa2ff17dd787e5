"""The whole calibration of a scene: true, in millimetres, repeatable, upright, and refused with names."""

from pathlib import Path

import numpy as np
import pytest

from calibration.adjustment.gauge import align_world
from calibration.result import CalibrationRefused
from calibration.scene.matching import Matches
from calibration.scene.scene import QUARTER, calibrate_scene, in_guessed_frame, judged, quarter_turns
from rig.errors import InputError
from rig.formats.pictures.images import write_image
from rig.geometry import RigidTransform, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.changed_rigs import reposed
from tests.support.textured_wedge import HEIGHT, WIDTH, solve, solved, wedge_rig, write_photographs


def test_the_rig_is_in_millimetres_and_in_the_world_frame() -> None:
    found, truth = solved(), wedge_rig()
    aligned = align_world(found.rig, truth)  # no scale: what is left is the tag's
    for camera in truth:
        there = camera.centre_world
        assert np.linalg.norm(aligned[camera.name].centre_world - there) < 0.02 * np.linalg.norm(there)
    front = found.rig["cam02"].centre_world
    assert front[0] == pytest.approx(0.0, abs=1e-6)
    assert front[2] > 300.0
    assert found.rig["cam00"].centre_world[0] < front[0] < found.rig["cam04"].centre_world[0]
    assert all(camera.covariance is not None for camera in found.rig)
    assert (found.front, found.left_out, found.warnings) == ("cam02", {}, ())


@pytest.mark.slow
def test_it_is_repeatable() -> None:
    assert solve().document() == solved().document()


@pytest.mark.slow
def test_shots_of_a_rig_share_its_cameras(tmp_path: Path) -> None:
    """Another texture in each shot: nothing of one is in the other, and both place the same cameras."""
    found = calibrate_scene(write_photographs(tmp_path, wedge_rig(), {"first": 0, "second": 1}), one_lens=True)
    assert found.rig.names == wedge_rig().names
    assert len(found.structure.points) > 1.5 * len(solved().structure.points)
    assert found.figures()["rms_px"] < 0.3


@pytest.mark.slow
def test_views_that_do_not_join_are_named(tmp_path: Path) -> None:
    photos = write_photographs(tmp_path, wedge_rig().subset(["cam00", "cam01", "cam02"]))
    write_image(photos / "dark.png", np.full((HEIGHT, WIDTH), 20, np.uint8))
    found = calibrate_scene(photos)
    document = found.document()
    assert document["scale"]["assumed"]
    assert any("ASSUMPTION" in warning for warning in document["warnings"])
    assert list(found.left_out) == ["dark"]
    assert "the view has only 0 distinct points" in found.left_out["dark"].text
    assert any(warning.text.startswith("left out: dark") for warning in found.warnings)
    with pytest.raises(CalibrationRefused, match="the front camera dark: the view has only 0"):
        calibrate_scene(photos, front="dark")


def test_faults_of_the_photographs_are_named(tmp_path: Path) -> None:
    photos = write_photographs(tmp_path, wedge_rig().subset(["cam00", "cam01", "cam02"]))
    with pytest.raises(InputError, match="'cam9' is not the name of a photograph"):
        calibrate_scene(photos, front="cam9")
    (photos / "cam00.png").write_bytes(b"no picture")
    write_image(photos / "cam01.png", np.zeros((50, 60), np.uint8))
    with pytest.raises(InputError, match=r"cam00\.png: the file is damaged"):
        calibrate_scene(photos)
    write_image(photos / "cam00.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="2 sizes"):
        calibrate_scene(photos, one_lens=True)


def test_half_of_the_views_must_join_and_too_few_are_refused_by_name(tmp_path: Path) -> None:
    """Asked of a structure, for a scene that falls apart so is slow to draw."""
    structure = solved().structure
    names = [*structure.rig.names, *(f"more{index}" for index in range(7))]
    matches = Matches((), True, dict.fromkeys(names, (640, 480)), dict.fromkeys(names, 500), {}, 0)
    with pytest.raises(CalibrationRefused, match="only 6 of 13 views could be joined into one scene; more0"):
        judged(structure, matches)
    rng = np.random.default_rng(0)
    for index in range(4):
        write_image(tmp_path / f"noise{index}.png", rng.integers(0, 255, (120, 160), dtype=np.uint8))
    with pytest.raises(CalibrationRefused, match=r"none of the 4 views .*; noise0: .*noise1: .*noise2: .*noise3: "):
        calibrate_scene(tmp_path)


ELSEWHERE = RigidTransform(rotation_from_vector(np.array([0.4, -1.1, 2.0])), np.array([30.0, -200.0, 900.0]))


def held(rig: Rig, turns: list[int]) -> Rig:
    """The cameras turned about their axes, in another world frame."""
    rolls = iter([RigidTransform(np.linalg.matrix_power(QUARTER, k), np.zeros(3)) for k in turns])
    return reposed(rig, lambda pose: next(rolls) @ pose @ ELSEWHERE)


def worst_deg(found: Rig, studio: Rig) -> float:
    """The studio's cameras are rolled by 1.1 degrees and stand 12 mm off, one by one: up is good to a few degrees."""
    cosines = []
    for camera in studio:
        ours, its = found[camera.name].centre_world, camera.centre_world
        cosines.append(ours @ its / np.linalg.norm(ours) / np.linalg.norm(its))
    return float(np.degrees(np.arccos(min(cosines))))


@pytest.mark.parametrize("turns", [[0] * 11, [0, 1, 0, 3, 2, 0, 0, 0, 1, 1, 0]])
def test_up_and_front_are_the_studios(turns: list[int]) -> None:
    studio = default_layout()
    assert worst_deg(in_guessed_frame(held(studio, turns), "cam00"), studio) < 8.0


@pytest.mark.parametrize("quarters", [1, 3])
def test_cameras_all_on_their_side_look_down_at_the_subject(quarters: int) -> None:
    studio = Rig(tuple(c for c in default_layout() if c.centre_world[1] > -10.0))
    assert len(studio) == 8
    assert worst_deg(in_guessed_frame(held(studio, [quarters] * 8), "cam00"), studio) < 8.0


def test_the_poses_differ_from_the_given_ones_by_one_motion_of_the_world() -> None:
    rig = held(default_layout(), [0, 1, 0, 3, 2, 0, 0, 0, 1, 1, 0])
    moves = [
        a.camera_from_world.inverse() @ b.camera_from_world
        for a, b in zip(rig, in_guessed_frame(rig, None), strict=True)
    ]
    for move in moves:
        np.testing.assert_allclose(move.rotation, moves[0].rotation, atol=1e-12)
        np.testing.assert_allclose(move.translation, moves[0].translation, atol=1e-9)


def test_turns_undo_how_the_cameras_were_held() -> None:
    turns = [0, 1, 0, 3, 2, 0, 0, 0, 1, 1, 0]
    assert ((quarter_turns(held(default_layout(), turns)) + turns) % 4 == 0).all()
