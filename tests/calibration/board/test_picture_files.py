"""Board pictures filed by camera or by shot."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.board.detection import detect_folder
from calibration.board.picture_files import filed_by_shot, list_pictures
from rig.errors import InputError
from tests.support.board_sessions import CHARUCO

ROOMS = {
    name: cv2.resize(np.random.default_rng(k).integers(0, 255, (6, 8), np.uint8), (320, 240))
    for k, name in enumerate("abc")
}


def write(root: Path, shots: Sequence[str], *, by_shot: bool, cameras: Sequence[str] = "abc") -> None:
    """Writes pictures of three rooms, in each of which a white patch wanders from shot to shot."""
    for k, shot in enumerate(shots):
        for camera, room in zip(cameras, ROOMS.values(), strict=True):
            picture = room.copy()
            picture[80:160, 60 * k : 60 * k + 80] = 255
            path = root / shot / f"{camera}.png" if by_shot else root / camera / f"{shot}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), picture)


@pytest.mark.parametrize("by_shot", [False, True])
@pytest.mark.parametrize("shots", [("001", "002", "003"), ("shot1", "shot2")])
def test_folders_of_shots_are_told_by_what_pictures_show(tmp_path: Path, shots: tuple[str, ...], by_shot: bool) -> None:
    write(tmp_path, shots, by_shot=by_shot)
    pictures = list_pictures(tmp_path)
    assert list(pictures) == ["a", "b", "c"]
    assert [list(of_camera) for of_camera in pictures.values()] == [[*shots]] * 3
    assert filed_by_shot(pictures) == by_shot


def test_folders_of_shots_are_told_by_names(tmp_path: Path) -> None:
    for shot in ("1", "2"):
        for camera in ("cam1", "cam2"):  # nothing to see in them
            (tmp_path / shot).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / shot / f"{camera}.png"), np.zeros((48, 64), np.uint8))
    assert list(list_pictures(tmp_path)) == ["cam1", "cam2"]


def test_cameras_by_name_stay_cameras(tmp_path: Path) -> None:
    write(tmp_path, ("cam1", "cam2"), by_shot=True, cameras=("s1", "s2", "s3"))  # each moves, the shots do not
    assert list(list_pictures(tmp_path)) == ["cam1", "cam2"]


def test_folders_of_shots_are_said(tmp_path: Path) -> None:
    write(tmp_path, ("001", "002", "003"), by_shot=True)
    assert [remark.code for remark in detect_folder(tmp_path, CHARUCO).remarks] == ["board-filed-by-shot"]


def test_names_that_are_no_cameras_are_said_once(tmp_path: Path) -> None:
    write(tmp_path, ("1", "2"), by_shot=False, cameras=("links ä", "größe", "日本"))
    with pytest.raises(InputError) as refused:
        list_pictures(tmp_path)
    (fault,) = refused.value.faults
    assert fault.text.endswith("the same is true of 2 more (links ä, 日本)")


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "absent"):
        with pytest.raises(InputError, match="wanted IMAGES"):
            list_pictures(folder)


def test_cameras_that_number_their_files_themselves_are_named(tmp_path: Path) -> None:
    for camera, prefix in (("left", "IMG_00"), ("right", "DSC_10")):
        write(tmp_path, [f"{prefix}{k}" for k in range(3)], by_shot=False, cameras=(camera, f"{camera}2", f"{camera}3"))
    for other in ("left2", "left3", "right2", "right3"):
        shutil.rmtree(tmp_path / other)
    with pytest.raises(InputError, match=r"no two cameras have a shot of the same name \(left has IMG_000, right has"):
        list_pictures(tmp_path)
