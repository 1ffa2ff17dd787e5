"""Clean plates that are not clean are told from those that are."""

import numpy as np

from rig.acquisition.judgement import occupied, plate_faults
from rig.acquisition.plates import NO_PLATES, Plates
from rig.formats.rig_toml import ShotConfig
from tests.support.textured_studio import NAMES, FlatStudio

EMPTY, SEATED = FlatStudio(False), FlatStudio(True)
CAMERAS = NAMES[:6]


def plates_of(studio: FlatStudio, light: float = 1.0) -> dict[str, list[np.ndarray]]:
    return {name: [(studio(name, 0.0) * light).astype(np.uint8) for _ in range(3)] for name in CAMERAS}


def in_use() -> Plates:
    return Plates({}, {name: images[0] for name, images in plates_of(EMPTY).items()}, {}, None)


def test_somebody_who_sits_in_the_new_plates_is_seen_by_comparison_and_another_wall_is_nobody() -> None:
    faults = occupied(plates_of(SEATED), in_use())
    assert {(fault.code, fault.camera) for fault in faults} == {("occupied", name) for name in CAMERAS}
    assert occupied(plates_of(EMPTY), in_use()) == []
    assert occupied(plates_of(EMPTY, light=0.8), in_use()) == [], "dimmer lamps are nobody"
    assert occupied(plates_of(SEATED), NO_PLATES) == [], "there is nothing to compare the first ones with"
    # A bumped camera is the reason for which new plates are taken.
    taken = plates_of(EMPTY)
    taken["cam02"] = [EMPTY("cam08", 0.0) for _ in range(3)]
    assert occupied(taken, in_use()) == []


def test_what_moves_stands_still_or_is_dark_is_named() -> None:
    taken = plates_of(EMPTY)
    assert plate_faults(taken, CAMERAS, ShotConfig()) == []
    taken["cam00"][1] = SEATED("cam00", 0.0)
    taken["cam01"][1] = taken["cam01"][0]
    taken["cam03"] = [image // 12 for image in taken["cam03"]]
    found = {(fault.code, fault.camera) for fault in plate_faults(taken, CAMERAS, ShotConfig())}
    assert found == {("disturbed", "cam00"), ("frozen", "cam01"), ("dark", "cam03")}
    recorded = plate_faults(taken, [], ShotConfig())
    assert ("frozen", "cam01") not in {(fault.code, fault.camera) for fault in recorded}
