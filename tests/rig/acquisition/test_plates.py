"""Clean plates on disk: versions that are kept, put to use, and let go."""

import os
from pathlib import Path

import numpy as np
import pytest

from rig.acquisition.plates import VERSIONS_MOST, keep_plates, plates_versions, read_plates, use_plates, write_plates
from rig.errors import InputError
from rig.messages.message import verbatim

CAMERAS = ("cam00", "cam01")
SOMEBODY = verbatim("cam00: occupied: somebody")


def pictures(value: int) -> dict[str, tuple[np.ndarray, ...]]:
    return {
        name: (np.full((20, 24, 3), value, np.uint8), np.full((20, 24, 3), value + 1, np.uint8)) for name in CAMERAS
    }


def value_in_use(folder: Path) -> int:
    return int(read_plates(folder, CAMERAS).first["cam01"][0, 0, 0])


def test_plates_that_were_replaced_are_put_back(tmp_path: Path) -> None:
    folder = tmp_path / "plates"
    assert plates_versions(folder) == []
    write_plates(folder, pictures(10))
    assert [path.name for path in tmp_path.iterdir()] == ["plates"], "the first ones leave nothing beside them"
    write_plates(folder, pictures(20))
    assert value_in_use(folder) == 20
    newest, before = plates_versions(folder)
    assert (newest.in_use, before.in_use, before.cameras) == (True, False, CAMERAS)
    plates = use_plates(folder, before.id, CAMERAS)
    assert value_in_use(folder) == 10
    assert all(file.is_file() for files in plates.files.values() for file in files)
    use_plates(folder, before.id, CAMERAS)  # they are in use already
    use_plates(folder, newest.id, CAMERAS)
    assert value_in_use(folder) == 20
    with pytest.raises(InputError, match="does not exist"):
        use_plates(folder, "../plates", CAMERAS)
    assert value_in_use(folder) == 20


def test_refused_plates_are_kept_beside_those_in_use(tmp_path: Path) -> None:
    folder = tmp_path / "plates"
    write_plates(folder, pictures(10))
    version = keep_plates(folder, pictures(30), (SOMEBODY,))
    assert value_in_use(folder) == 10
    assert plates_versions(folder)[0].refused == (SOMEBODY,)
    use_plates(folder, version, CAMERAS)
    assert value_in_use(folder) == 30


def test_old_versions_are_let_go(tmp_path: Path) -> None:
    for value in range(VERSIONS_MOST + 3):
        write_plates(tmp_path / "plates", pictures(value))
    kept = plates_versions(tmp_path / "plates")
    assert len(kept) == VERSIONS_MOST
    assert value_in_use(tmp_path / "plates") == VERSIONS_MOST + 2


def test_refused_versions_are_let_go_and_so_is_what_a_crash_left(tmp_path: Path) -> None:
    folder, left = tmp_path / "plates", tmp_path / "plates.versions" / "20260101T000000000000Z.new"
    write_plates(folder, pictures(10))
    left.mkdir(parents=True)
    os.utime(left, (0.0, 0.0))
    for value in range(VERSIONS_MOST + 3):
        keep_plates(folder, pictures(value), (SOMEBODY,))
    assert not left.exists()
    assert len(list(left.parent.iterdir())) == VERSIONS_MOST
    assert value_in_use(folder) == 10


def test_plates_that_came_from_elsewhere_become_a_version(tmp_path: Path) -> None:
    folder = tmp_path / "plates"
    write_plates(folder, pictures(40))
    (folder / "plates.json").unlink()
    write_plates(folder, pictures(50))
    _, foreign = plates_versions(folder)
    use_plates(folder, foreign.id, CAMERAS)
    assert value_in_use(folder) == 40
