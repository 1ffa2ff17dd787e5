"""Faults that pictures have, judged without the pictures of the other cameras: as uploads are."""

import cv2
import numpy as np

from rig.acquisition.judgement import examine_picture, judge_checks, plate_level
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


def test_without_a_clean_plate_neither_light_nor_view_is_judged() -> None:
    pictures = {name: SEATED(name, 0.0) // 8 for name in NAMES[:3]}
    assert judged(pictures, {}) == set()
