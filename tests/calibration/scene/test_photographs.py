"""Which photographs a folder holds: the layouts, and what is wrong with others."""

from pathlib import Path

import numpy as np
import pytest

from calibration.scene.photographs import find_masks, find_photographs
from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.pictures.images import write_image
from tests.support.services import small_capture


def fill(folder: Path, *files: str) -> Path:
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"")
    return folder


@pytest.mark.parametrize("inside", ["", "images/"])
def test_one_picture_a_camera(tmp_path: Path, inside: str) -> None:
    fill(tmp_path, *(f"{inside}{name}" for name in ("b.jpg", "a.PNG", "c.tif", ".hidden.png", "notes.txt")))
    found = find_photographs(tmp_path)
    assert found.names == ("a", "b", "c")
    assert len(found.shots) == 1


def test_a_folder_a_camera(tmp_path: Path) -> None:
    found = find_photographs(fill(tmp_path, "b/1.jpg", "a/2.jpg", "a/1.jpg", "c/1.jpg", "notes/x.txt"))
    assert found.names == ("a", "b", "c")
    assert list(found.files["a"]) == ["1", "2"]
    assert found.shots == ("1", "2")


@pytest.mark.parametrize(
    ("files", "text"),
    [
        (("a.jpg", "b.jpg"), "2 photographs; at least 3"),
        (("a.jpg", "b/1.jpg", "c/1.jpg"), "photographs beside folders"),
        (("a.jpg", "a.png", "b.jpg", "c.jpg"), "holds a 2 times"),
        (("a/1.jpg", "a/1.png", "b/1.jpg", "c/1.jpg"), "a holds 1 2 times"),
        (("my\u202ehead.jpg", "b.jpg", "c.jpg"), "becomes the name of files"),
        ((), "0 photographs"),
    ],
)
def test_faults_are_named(tmp_path: Path, files: tuple[str, ...], text: str) -> None:
    with pytest.raises(InputError, match=text):
        find_photographs(fill(tmp_path / "photos", "readme.txt", *files))


def test_a_mask_of_another_size_is_a_fault(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "shot")  # 24 x 24 pixels
    for name, size in (("cam00", 24), ("cam01", 12)):
        mask = np.zeros((size, size), np.uint8)
        mask[size // 4 : size * 3 // 4, size // 4 : size * 3 // 4] = 255
        write_image(folder / "masks" / f"{name}.png", mask)
    rig = read_rig(folder / "cameras.json")
    with pytest.raises(InputError) as refused:
        find_masks(folder, find_photographs(folder / "images"), rig)
    (fault,) = refused.value.faults
    assert fault.text.startswith("masks/cam01.png is 12 x 12 pixels, but its camera is 24 x 24")


def test_masks_in_colmap_s_names_are_found(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    rig = read_rig(folder / "cameras.json")
    (folder / "masks").mkdir()
    drawn = np.zeros((24, 24), np.uint8)
    drawn[6:18, 6:18] = 255
    for path in sorted((folder / "images").iterdir()):
        write_image(folder / "masks" / f"{path.name}.png", drawn)
    masks = find_masks(folder, find_photographs(folder / "images"), rig)
    assert set(masks) == set(rig.names)
    assert all((mask == (drawn > 0)).all() for mask in masks.values())
