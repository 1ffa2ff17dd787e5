"""Corners found in rendered pictures against where they were put; what is wrong is said, not guessed."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.adjustment.intrinsics import estimate_lenses
from calibration.board.board import Board, photograph_board, read_board
from calibration.board.corners import detect
from calibration.board.detection import detect_folder, explain
from rig.errors import InputError
from tests.support.board_sessions import CHARUCO, CHECKERBOARD, session, visible
from tests.support.shared_data import shared

EVEN = Board("checkerboard", 8, 6, 25.0)  # both sides even: chiral, and the same when turned by 180 degrees


def picture(board: Board, index: int = 40, blur_px: float = 0.6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture with the corners' numbers and pixels."""
    planted = session(seed=2)
    view = planted.detections.views[index]
    camera, pose = planted.rig[view.camera], planted.poses[view.shot]
    grey = photograph_board(board, pose, camera, np.random.default_rng(index), blur_px=blur_px)
    return grey, *visible(camera, pose, board)


@pytest.mark.parametrize(
    "board", [CHECKERBOARD, CHARUCO, replace(CHARUCO, inverted=True)], ids=["plain", "charuco", "inv"]
)
def test_corners_are_found_to_a_tenth_of_a_pixel(board: Board) -> None:
    grey, ids, pixels = picture(board)
    found = detect(grey, board)
    assert found is not None
    common = np.intersect1d(ids, found.ids)
    assert len(common) > 0.9 * len(ids)
    apart = found.corners[np.isin(found.ids, common)] - pixels[np.isin(ids, common)]
    assert np.sqrt((apart**2).sum(axis=1).mean()) < 0.1
    assert 1.0 < found.rise_px < 3.0


def test_a_board_with_even_sides_is_found_up_to_a_half_turn() -> None:
    grey, _, pixels = picture(EVEN)
    found = detect(grey, EVEN)
    assert found is not None
    misses = [np.abs(found.corners - pixels[turn]).max() for turn in EVEN.turns()]
    assert min(misses) < 0.5


def test_blur_is_measured() -> None:
    grey, _, _ = picture(CHARUCO, 100, blur_px=1.2)
    found = detect(grey, CHARUCO)
    assert found is not None
    # A Gaussian edge of sigma s rises from 10 to 90 % over 2.56 s; the pixels themselves add a little.
    assert found.rise_px == pytest.approx(2.56 * np.hypot(1.2, 0.4), rel=0.2)


@pytest.mark.parametrize("board", [CHARUCO, EVEN], ids=["charuco", "even"])
def test_a_mirrored_picture_is_refused_and_named(board: Board) -> None:
    mirrored = np.ascontiguousarray(picture(board)[0][:, ::-1])
    assert detect(mirrored, board) is None
    reason = explain(mirrored, board)
    assert reason is not None
    assert "mirror" in reason.text


@pytest.mark.parametrize(
    ("board", "columns", "said"),
    [
        pytest.param(CHECKERBOARD, 7, "the picture shows 9 x 6", marks=pytest.mark.slow),
        pytest.param(CHECKERBOARD, 10, "the picture shows 9 x 6", marks=pytest.mark.slow),
        (CHARUCO, 7, "shows 9 squares in a row"),
    ],
)
def test_a_wrong_square_count_is_refused_and_named(board: Board, columns: int, said: str) -> None:
    grey, _, _ = picture(board)
    wrong = replace(board, columns=columns)
    assert detect(grey, wrong) is None
    reason = explain(grey, wrong)
    assert reason is not None
    assert said in reason.text


def write_pictures(folder: Path, board: Board, shots: int = 2) -> None:
    for shot in range(shots):
        for camera in ("left", "right"):
            (folder / camera).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / camera / f"shot{shot}.png"), picture(board, 30 + 11 * shot)[0])


def test_a_folder_is_detected_and_remembered(tmp_path: Path) -> None:
    write_pictures(tmp_path / "images", CHARUCO)
    stages: list[float] = []
    first = detect_folder(
        tmp_path / "images", CHARUCO, cache=tmp_path / "cache", report=lambda stage, done: stages.append(done)
    )
    assert len(first.views) == 4
    assert stages[-1] == 1.0
    kept = sorted((tmp_path / "cache").iterdir())
    assert kept
    kept[0].write_bytes(b"damaged")  # is found again, not believed
    again = detect_folder(tmp_path / "images", CHARUCO, cache=tmp_path / "cache")
    for a, b in zip(first.views, again.views, strict=True):
        np.testing.assert_array_equal(a.found.corners, b.found.corners)


def test_every_damaged_picture_is_named(tmp_path: Path) -> None:
    write_pictures(tmp_path, CHARUCO, shots=1)
    (tmp_path / "left" / "shot1.png").write_bytes(b"\x89PNG nothing")
    cv2.imwrite(str(tmp_path / "right" / "shot1.png"), np.zeros((100, 90), np.uint8))
    with pytest.raises(InputError) as error:
        detect_folder(tmp_path, CHARUCO)
    assert any("left/shot1.png: the file is not a picture" in fault.text for fault in error.value.faults)
    assert any("right/shot1.png is 90 x 100" in fault.text for fault in error.value.faults)


@pytest.mark.slow
def test_real_checkerboards_give_the_lenses_of_one_kind_of_phone() -> None:
    folder = shared("data/checkerboards")
    detections = detect_folder(folder, read_board(folder / "board.toml"))
    assert len(detections.views) >= 24  # of 28, as many as the classic detector; SB alone finds 12
    lenses = estimate_lenses(detections)
    focal = np.array([lens.intrinsics.fx for lens in lenses.values()])
    # Four phones of one make; the authors' own calibration has 1681 px. Ours have a standard deviation of 1 to 2 px.
    assert np.abs(focal - 1675).max() < 10
    for lens in lenses.values():
        assert lens.rms_px < 0.3
        assert lens.weakness is None
