"""Capture folders: what is written is read back; every layout of docs/capture-format.md; every fault named at once."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.captures.capture_folder import full_size_reader, read_capture, write_capture
from rig.formats.pictures.images import read_image, write_image
from tests.support.small_captures import (
    FEATURES,
    HEIGHT,
    WIDTH,
    all_points,
    damage,
    feature,
    picture,
    png,
    points,
    remove,
    rename,
    small_capture,
    small_rig,
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    capture = small_capture()
    write_capture(tmp_path, capture, small_rig())
    again, rig = read_capture(tmp_path)
    assert rig.names == ("a", "b", "c")
    for name in "abc":
        np.testing.assert_array_equal(again.images[name], capture.images[name])
        assert not again.images[name].flags.writeable
    assert {name: len(plates) for name, plates in again.backgrounds.items()} == {"a": 1, "b": 2}
    np.testing.assert_array_equal(again.backgrounds["b"][1], capture.backgrounds["b"][1])
    np.testing.assert_array_equal(again.masks["c"], capture.masks["c"])
    np.testing.assert_array_equal(again.features["pronasale"]["b"], [-0.5, 47.5])
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert set(again.digests) == files
    assert list(again.digests) == sorted(again.digests)


def test_a_colmap_model_in_place_of_cameras_json(folder: Path) -> None:
    from rig.formats.cameras.colmap import write_colmap

    rig = small_rig()
    (folder / "cameras.json").unlink()
    write_colmap(rig, folder / "sparse" / "0")
    capture, again = read_capture(folder)
    assert again.names == rig.names
    # Both files that were read count for the digest, and the points, which were not, do not.
    assert {path for path in capture.digests if path.startswith("sparse")} == {
        "sparse/0/cameras.txt",
        "sparse/0/images.txt",
    }


def astray(folder: Path) -> None:
    (folder / "images" / "a.png").unlink()
    (folder / "images" / "a.png").symlink_to("/mnt/away/a.png")


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (remove("images/b.png"), "images/b.png is missing"),
        (remove("background/a.png"), "background/a.png is missing: a clean plate, or masks/a.png, is needed"),
        (
            damage("images/b.png", b"no picture"),
            "images/b.png is damaged or no PNG, JPEG, TIFF, WebP, BMP, PPM, RAW or HEIC picture",
        ),
        (damage("images/b.png", png(picture())[:-40]), "images/b.png is damaged and cannot be decoded: send"),
        (damage("images/b.png", png(picture()[:20])), "images/b.png is 64 x 20 pixels, but its camera is 64 x 48"),
        (damage("images/b.jpg", png(picture())), "images/ holds b.jpg, b.png: which one is meant?"),
        (damage("background/b/001.png", b""), "background/b/001.png is damaged"),
        (damage("masks/c.png", png(np.zeros((HEIGHT, WIDTH), np.uint8))), "masks/c.png is empty"),
        (rename("masks/c.png", "masks/c.gif"), "masks/c.gif is not read: GIF files are not supported"),
        (astray, "images/a.png is a link to a file that is not there: /mnt/away/a.png"),
        (rename("background", "backgrounds"), "backgrounds/ is not read: call it background/"),
        (rename("masks", "mask"), "mask/ is not read: call it masks/"),
        (rename("images", "image"), "image/ is not read: call it images/"),
        (remove("cameras.json"), "contains no cameras.json"),
        (rename("cameras.json", "inner.zip"), "holds an archive (inner.zip)"),
        (rename("background/a.png", "background/a.npy"), "background/a.npy is not read: NumPy files are not supported"),
        (damage("features.json", b"{"), "features.json cannot be read as JSON"),
        (points([]), "features.json is no object"),
        (points({"points": {}}), "features.json: format is None"),
        (points({"format": FEATURES, "points": {f"p{i}": {} for i in range(201)}}), "201 points, at most 200"),
        (feature([1, 2]), "'pronasale' is no object of camera"),
        (feature({"z": [1, 2]}), "names camera 'z', which the rig does not have"),
        (feature({"a": [1]}), "is no pair of finite pixels"),
        (feature({"a": [1, float("nan")]}), "is no pair of finite pixels"),
        (feature({"a": [1, 10**400]}), "is no pair of finite pixels"),
        (feature({"a": [True, 2]}), "is no pair of finite pixels"),
        (feature({"a": [64.0, 2]}), "lies outside the image"),
        (all_points(lambda name, at: (name, [at[0] / 64, at[1] / 48])), "the points are shares of the picture's size"),
        (all_points(lambda name, at: (name, [4 * at[0], 4 * at[1]])), "9 of 9 points lie outside their pictures"),
        (all_points(lambda name, at: (name, [at[1], at[0]])), "the points agree once rows and columns are exchanged"),
        (all_points(lambda name, at: (name, [*at, 0.9])), "is no pair of finite pixels; the same is true of 8 more"),
        (all_points(lambda name, at: (name, None)), "is no pair of finite pixels; the same is true of 8 more"),
        (all_points(lambda name, at: (f"x{name}", at)), "which the rig does not have; the same is true of 8 more"),
        (
            points({"format": FEATURES, "points": {c: {"pronasale": [9, 9], "gnathion": [8, 8]} for c in "abc"}}),
            "the points are listed by camera",
        ),
    ],
)  # fmt: skip
def test_a_fault_is_named(folder: Path, harm: Callable[[Path], None], words: str) -> None:
    harm(folder)
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert len(caught.value.faults) == 1
    assert words in caught.value.faults[0].text


def test_a_plate_and_a_folder_of_plates_go_together(folder: Path) -> None:
    """A picture with a colour chart is put beside the plate that is there already."""
    name = read_capture(folder)[1].names[0]
    single = next(path for path in (folder / "background").iterdir() if path.stem == name)
    (folder / "background" / name).mkdir()
    write_image(folder / "background" / name / "chart.png", 255 - read_image(single))
    plates = read_capture(folder)[0].backgrounds[name]
    assert len(plates) == 2
    np.testing.assert_array_equal(plates[0], 255 - plates[1])


def test_names_may_differ_in_case_and_a_camera_may_be_called_as_its_picture(folder: Path) -> None:
    (folder / "images" / "a.png").rename(folder / "images" / "A.PNG")
    (folder / "background" / "a.png").rename(folder / "background" / "A.png")
    (folder / "masks" / "c.png").rename(folder / "masks" / "C.png")
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][1]["name"] = "b.png"
    (folder / "cameras.json").write_text(json.dumps(document))
    (folder / "background" / "b").rename(folder / "background" / "b.png")
    (folder / "features.json").unlink()
    capture, rig = read_capture(folder)
    assert set(capture.images) == set(rig.names) == {"a", "b.png", "c"}
    assert set(capture.backgrounds) == {"a", "b.png"}
    assert set(capture.masks) == {"c"}


def test_two_spellings_of_one_name_are_no_guess(folder: Path) -> None:
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][1]["name"] = "A"  # beside "a"
    (folder / "cameras.json").write_text(json.dumps(document))
    (folder / "features.json").unlink()
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert any("images/A.png is missing" in fault.text for fault in caught.value.faults)


def test_all_faults_are_named_at_once(folder: Path) -> None:
    (folder / "images" / "a.png").unlink()
    (folder / "images" / "b.png").write_bytes(b"")
    (folder / "features.json").write_text("[]")
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert len(caught.value.faults) == 3


def test_a_rig_s_faults_come_with_its_file_s_name_and_captures_in_a_folder_are_named(folder: Path) -> None:
    (folder / "cameras.json").write_text("{}")
    with pytest.raises(InputError, match=r"capture: cameras\.json: "):
        read_capture(folder)
    with pytest.raises(InputError, match="is no folder"):
        read_capture(folder / "absent")
    for name in ("monday", "tuesday"):
        write_capture(folder.parent / "week" / name, small_capture(), small_rig())
    with pytest.raises(InputError, match="but monday, tuesday do: give one of these"):
        read_capture(folder.parent / "week")


@pytest.mark.parametrize("locked", ["a.png", "cameras.json"])
def test_what_may_not_be_read_is_neither_damaged_nor_wrong(
    folder: Path, monkeypatch: pytest.MonkeyPatch, locked: str
) -> None:
    read_bytes = Path.read_bytes

    def refused(path: Path) -> bytes:
        if path.name == locked and path.parent.name != "background":
            raise PermissionError(13, "Permission denied")
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\)"):
        read_capture(folder)


def test_a_reduced_picture_is_read_at_full_size(tmp_path: Path) -> None:
    write_capture(tmp_path, whole := small_capture(), small_rig())
    reduced, _ = read_capture(tmp_path, pixels_most=800)
    assert reduced.images["b"].shape == (24, 32, 3)
    read = full_size_reader(tmp_path, small_rig())
    np.testing.assert_array_equal(read("b"), whole.images["b"])
    (tmp_path / "images" / "b.png").unlink()
    with pytest.raises(InputError):
        read("b")
