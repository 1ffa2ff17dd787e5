"""Capture folders: what is written is read back; every layout of docs/capture-format.md; every fault named;
masks and texture sets."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.capture import Capture, reassign_images
from rig.errors import InputError
from rig.formats.captures.capture_folder import full_size_reader, read_capture, write_capture
from rig.formats.pictures.images import read_image, write_image
from rig.messages.message import texts_of
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
            "images/b.png: the file is damaged or no PNG, JPEG, TIFF, WebP, BMP, PPM, RAW or HEIC picture",
        ),
        (damage("images/b.png", png(picture())[:-40]), "images/b.png: the picture is damaged and cannot be decoded:"),
        (damage("images/b.png", png(picture()[:20])), "images/b.png is 64 x 20 pixels, but its camera is 64 x 48"),
        (damage("images/b.jpg", png(picture())), "images/ holds b.jpg, b.png: which one is meant?"),
        (damage("background/b/001.png", b""), "background/b/001.png: the file is damaged"),
        (damage("masks/c.png", png(np.zeros((HEIGHT, WIDTH), np.uint8))), "masks/c.png: the mask is empty"),
        (rename("masks/c.png", "masks/c.gif"), "masks/c.gif is not read: GIF files are not supported"),
        (astray, "images/a.png is a link to a file that is not there: /mnt/away/a.png"),
        (rename("background", "backgrounds"), "backgrounds/ is not read: call it background/"),
        (rename("masks", "mask"), "mask/ is not read: call it masks/"),
        (rename("images", "image"), "image/ is not read: call it images/"),
        (remove("cameras.json"), "contains no cameras.json"),
        (rename("cameras.json", "inner.zip"), "holds an archive (inner.zip)"),
        (rename("background/a.png", "background/a.npy"), "background/a.npy is not read: NumPy files are not supported"),
        (damage("features.json", b"{"), "features.json: the file cannot be read as JSON"),
        (points([]), "features.json: the file is no object"),
        (points({"points": {}}), "features.json: the format is None"),
        (points({"format": FEATURES, "points": {f"p{i}": {} for i in range(201)}}), "201 points, at most 200"),
        (feature([1, 2]), "'pronasale': the point is no object of camera"),
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


def test_a_rig_s_faults_come_with_its_file_s_name_and_captures_in_a_folder_are_named(folder: Path) -> None:
    (folder / "cameras.json").write_text("{}")
    with pytest.raises(InputError, match=r"capture: cameras\.json: "):
        read_capture(folder)
    with pytest.raises(InputError, match="is no folder"):
        read_capture(folder / "absent")
    for name in ("monday", "tuesday"):
        write_capture(folder.parent / "week" / name, small_capture(), small_rig())
    with pytest.raises(InputError, match="but monday, tuesday do: name one of these"):
        read_capture(folder.parent / "week")


@pytest.mark.parametrize("locked", ["a.png", "cameras.json"])
def test_what_may_not_be_read_is_called_unreadable(folder: Path, monkeypatch: pytest.MonkeyPatch, locked: str) -> None:
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


@pytest.fixture
def polarised(folder: Path) -> Path:
    """A capture with two complete sets."""
    for kind in ("cross", "parallel"):
        for name in "abc":
            write_image(folder / "texture_sets" / kind / f"{name}.png", picture())
    return folder


def test_sets_are_read_and_reduced_with_the_photographs(polarised: Path) -> None:
    capture, _ = read_capture(polarised)
    assert {kind: set(images) for kind, images in capture.texture_sets.items()} == {
        "cross": set("abc"),
        "parallel": set("abc"),
    }
    assert capture.texture_sets["cross"]["a"].shape == (HEIGHT, WIDTH, 3)
    assert "texture_sets/parallel/c.png" in capture.digests
    assert capture.remarks == ()
    capture, _ = read_capture(polarised, pixels_most=HEIGHT * WIDTH // 4)
    assert capture.texture_sets["cross"]["b"].shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_pictures_of_exchanged_cameras_are_exchanged_in_every_set(polarised: Path) -> None:
    capture, _ = read_capture(polarised)
    turned = reassign_images(capture, pictures={"a": "b", "b": "a"})
    np.testing.assert_array_equal(turned.texture_sets["cross"]["a"], capture.texture_sets["cross"]["b"])
    assert turned.digests["texture_sets/cross/a.png"] == capture.digests["texture_sets/cross/b.png"]


def _many(folder: Path) -> None:
    for number in range(7):
        shutil.copytree(folder / "texture_sets" / "cross", folder / "texture_sets" / f"set{number}")


Spoil = Callable[[Path], object]
SPOILT: dict[str, tuple[Spoil, str]] = {
    "a view is missing": (
        lambda f: (f / "texture_sets/cross/b.png").unlink(),
        "texture_sets/cross/ lacks the picture of b",
    ),
    "two views are missing": (
        lambda f: [(f / f"texture_sets/cross/{name}.png").unlink() for name in "ac"],
        "texture_sets/cross/ lacks the pictures of a, c",
    ),
    "an empty set": (lambda f: (f / "texture_sets/uv").mkdir(), "texture_sets/uv/ lacks the pictures of a, b, c"),
    "a camera that does not exist": (
        lambda f: write_image(f / "texture_sets/parallel/nobody.png", picture()),
        "texture_sets/parallel/nobody.png has no camera",
    ),
    "another size": (
        lambda f: write_image(f / "texture_sets/cross/a.png", picture()[:-4]),
        f"texture_sets/cross/a.png is {WIDTH} x {HEIGHT - 4} pixels, but its camera is {WIDTH} x {HEIGHT}",
    ),
    "a damaged picture": (
        lambda f: (f / "texture_sets/cross/c.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40)),
        "texture_sets/cross/c.png: the file is damaged",
    ),
    "a kind that is not read": (
        lambda f: (f / "texture_sets/cross/c.png").rename(f / "texture_sets/cross/c.exr"),
        "texture_sets/cross/c.exr is not read: OpenEXR files are not supported",
    ),
    "two pictures of a camera": (
        lambda f: write_image(f / "texture_sets/cross/c.jpg", picture()),
        "texture_sets/cross/ holds c.jpg, c.png: which one is meant?",
    ),
    "a name with capitals and spaces": (
        lambda f: (f / "texture_sets/cross").rename(f / "texture_sets/Cross polarised"),
        "texture_sets/Cross polarised/ cannot be the name of a texture set",
    ),
    "a picture beside the sets": (
        lambda f: write_image(f / "texture_sets/a.png", picture()),
        "texture_sets/a.png belongs to no texture set",
    ),
    "nine sets": (_many, "texture_sets/ holds 9 sets; at most 8 are read"),
    "a folder almost of that name": (
        lambda f: (f / "texture_sets").rename(f / "texture-sets"),
        "texture-sets/ is not read: call it texture_sets/",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_every_fault_of_a_set_is_one_sentence(polarised: Path, case: str) -> None:
    spoil, sentence = SPOILT[case]
    spoil(polarised)
    with pytest.raises(InputError) as refusal:
        read_capture(polarised)
    (fault,) = texts_of(refusal.value.faults)
    assert fault.startswith(sentence)


def test_names_are_matched_as_those_of_photographs_are_and_junk_is_passed_over(polarised: Path) -> None:
    place = polarised / "texture_sets" / "cross"
    (polarised / "texture_sets" / ".DS_Store").write_bytes(b"x")
    (place / "Thumbs.db").write_bytes(b"x")
    for name in small_rig().names:
        (place / f"{name}.png").rename(place / f"shot_{name.upper()}.png")
    sets = read_capture(polarised)[0].texture_sets
    assert (len(sets), set(sets["cross"])) == (2, set("abc"))


ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))
BUST = (np.hypot(COLUMNS - 32, ROWS - 22) < 10) | ((ROWS > 32) & (np.abs(COLUMNS - 32) < 22))


@pytest.fixture
def masked(tmp_path: Path) -> Path:
    images = {name: picture() for name in "abc"}
    write_capture(tmp_path, Capture(images, masks=dict.fromkeys("abc", BUST)), small_rig())
    return tmp_path


def write_mask(masked: Path, name: str, pixels: np.ndarray) -> None:
    cv2.imwrite(str(masked / "masks" / f"{name}.png"), pixels)


@pytest.mark.parametrize(("names", "words"), [("abc", "all masks are inverted"), ("b", "masks/b.png is inverted")])
def test_inverted_masks_are_turned_and_told(masked: Path, names: str, words: str) -> None:
    for name in names:
        write_mask(masked, name, np.where(BUST, 0, 255).astype(np.uint8))
    capture, _ = read_capture(masked)
    for name in "abc":
        np.testing.assert_array_equal(capture.masks[name], BUST)
    (remark,) = capture.remarks
    assert remark.code == "mask-inverted"
    assert words in remark.text


def test_soft_masks_keep_their_greys_and_are_written_with_them(masked: Path, tmp_path: Path) -> None:
    soft = cv2.GaussianBlur(BUST.astype(np.uint8) * np.uint8(255), (0, 0), 0.8)
    write_mask(masked, "a", 255 - soft)
    capture, rig = read_capture(masked)
    assert set(capture.soft_masks) == {"a"}
    np.testing.assert_allclose(capture.soft_masks["a"].astype(float), soft, atol=2)
    write_capture(tmp_path / "again", capture, rig)
    again, _ = read_capture(tmp_path / "again")
    np.testing.assert_array_equal(again.masks["a"], capture.masks["a"])


def test_specks_apart_from_the_subject_are_taken_away_and_told(masked: Path) -> None:
    specked = BUST.astype(np.uint8) * np.uint8(255)
    specked[3:7, 2:5] = 255
    specked[5, 3] = 0  # a hole in a speck goes with it
    specked[20, 60] = 255
    write_mask(masked, "b", specked)
    capture, _ = read_capture(masked)
    np.testing.assert_array_equal(capture.masks["b"], BUST)
    (remark,) = capture.remarks
    assert remark.code == "mask-specks"
    assert remark.text.startswith("masks/b.png: small pieces apart from the subject")


def test_a_head_above_a_collar_that_cuts_it_off_stays(masked: Path) -> None:
    parted = BUST & ((ROWS < 28) | (ROWS > 33))
    write_mask(masked, "b", parted.astype(np.uint8) * np.uint8(255))
    capture, _ = read_capture(masked)
    np.testing.assert_array_equal(capture.masks["b"], parted)
    assert capture.remarks == ()


def test_what_is_true_of_all_masks_is_said_once(masked: Path) -> None:
    for name in "abc":
        write_mask(masked, name, np.where(BUST, 1 + ROWS // 12, 0).astype(np.uint8))
    with pytest.raises(InputError) as refused:
        read_capture(masked)
    (fault,) = refused.value.faults
    assert fault.text.startswith("masks/a.png: the mask holds areas of 4 values")
    assert fault.text.endswith("the same is true of 2 more (b, c)")
