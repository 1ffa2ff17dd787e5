"""Faults that pictures have, judged without the pictures of the other cameras: as uploads are; clean plates."""

import cv2
import numpy as np

from rig.acquisition.judgement import examine_picture, find_occupied, judge_checks, plate_faults, plate_level
from rig.acquisition.plates import NO_PLATES, Plates
from rig.formats.rig_toml import ShotConfig
from tests.support.textured_studio import NAMES, FlatStudio

EMPTY, SEATED = FlatStudio(False, 640, 480), FlatStudio(True, 640, 480)


def judged(pictures: dict[str, np.ndarray], plates: dict[str, np.ndarray]) -> set[tuple[str, str | None]]:
    checks = {name: examine_picture(image, plates.get(name)) for name, image in pictures.items()}
    faults = judge_checks(checks, {name: plate_level(plate) for name, plate in plates.items()}, ShotConfig())
    assert all(fault.remedy for fault in faults)
    return {(fault.code, fault.camera) for fault in faults}


def test_each_fault_is_named_for_its_camera() -> None:
    pictures = {name: SEATED(name, 0.0) for name in NAMES[:6]}
    plates = {name: EMPTY(name, 0.0) for name in NAMES[:6]}
    assert judged(pictures, plates) == set()
    pictures["cam01"] = np.roll(pictures["cam01"], (8, 3), axis=(1, 0))  # bumped by 8.5 px
    pictures["cam02"] = cv2.GaussianBlur(pictures["cam02"], (0, 0), 4.0)
    pictures["cam03"][:, :64] = 255
    pictures["cam04"] = pictures["cam04"] // 6
    pictures["cam05"] = EMPTY("cam09", 0.0)
    expected = {("moved", "cam01"), ("blurred", "cam02"), ("overexposed", "cam03"), ("dark", "cam04")}
    assert judged(pictures, plates) == expected | {("view", "cam05")}


def test_without_a_clean_plate_nothing_is_judged_and_before_a_plain_wall_no_camera_moved() -> None:
    pictures = {name: SEATED(name, 0.0) // 8 for name in NAMES[:3]}
    assert judged(pictures, {}) == set()
    # Few patches there can be placed, and what they say of the corners is an extrapolation.
    pictures = {name: plain_wall(seed, seated=True) for seed, name in enumerate(NAMES)}
    plates = {name: plain_wall(seed, seated=False) for seed, name in enumerate(NAMES)}
    assert judged(pictures, plates) == set()


def plain_wall(seed: int, *, seated: bool) -> np.ndarray:
    """A wall under a soft lamp with few marks on it; the subject throws a soft shadow."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:480, :640].astype(np.float32)
    wall = 90 + 60 * np.exp(-(((columns - 400) / 380) ** 2) - ((rows - 150) / 300) ** 2)
    for column, row in rng.uniform((40, 40), (600, 440), (5, 2)):
        wall += 6 * np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / (2 * 9.0**2))
    if seated:
        wall *= 1 - 0.25 * np.exp(-(((columns - 230) / 110) ** 2) - ((rows - 260) / 160) ** 2)
        cv2.ellipse(wall, (320, 300), (90, 130), 0, 0, 360, 150.0, -1, cv2.LINE_AA)
    noise = np.random.default_rng(seed + 100 * (1 + seated)).normal(0, 2.0, (480, 640, 3))
    return np.clip(np.round(wall[..., None] + noise), 0, 255).astype(np.uint8)


SMALL_EMPTY, SMALL_SEATED = FlatStudio(False), FlatStudio(True)
CAMERAS = NAMES[:6]


def plates_of(studio: FlatStudio, light: float = 1.0) -> dict[str, list[np.ndarray]]:
    return {name: [(studio(name, 0.0) * light).astype(np.uint8) for _ in range(3)] for name in CAMERAS}


def in_use() -> Plates:
    return Plates({}, {name: images[0] for name, images in plates_of(SMALL_EMPTY).items()}, {}, None)


def test_somebody_who_sits_in_the_new_plates_is_seen_by_comparison_and_another_wall_is_nobody() -> None:
    faults = find_occupied(plates_of(SMALL_SEATED), in_use())
    assert {(fault.code, fault.camera) for fault in faults} == {("occupied", name) for name in CAMERAS}
    assert find_occupied(plates_of(SMALL_EMPTY), in_use()) == []
    assert find_occupied(plates_of(SMALL_EMPTY, light=0.8), in_use()) == [], "dimmer lamps are nobody"
    assert find_occupied(plates_of(SMALL_SEATED), NO_PLATES) == [], "there is nothing to compare the first ones with"
    # A bumped camera is the reason for which new plates are taken.
    taken = plates_of(SMALL_EMPTY)
    taken["cam02"] = [SMALL_EMPTY("cam08", 0.0) for _ in range(3)]
    assert find_occupied(taken, in_use()) == []


def test_what_moves_stands_still_or_is_dark_is_named() -> None:
    taken = plates_of(SMALL_EMPTY)
    assert plate_faults(taken, CAMERAS, ShotConfig()) == []
    taken["cam00"][1] = SMALL_SEATED("cam00", 0.0)
    taken["cam01"][1] = taken["cam01"][0]
    taken["cam03"] = [image // 12 for image in taken["cam03"]]
    found = {(fault.code, fault.camera) for fault in plate_faults(taken, CAMERAS, ShotConfig())}
    assert found == {("disturbed", "cam00"), ("frozen", "cam01"), ("dark", "cam03")}
    recorded = plate_faults(taken, [], ShotConfig())
    assert ("frozen", "cam01") not in {(fault.code, fault.camera) for fault in recorded}
