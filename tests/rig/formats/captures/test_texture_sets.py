"""Further photographs by the same cameras lie in texture_sets/<set>/."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rig.capture import reassign_images
from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture
from rig.formats.pictures.images import write_image
from rig.messages.message import texts_of
from tests.support.small_captures import HEIGHT, WIDTH, picture, small_rig


@pytest.fixture
def polarised(folder: Path) -> Path:
    """A capture with two complete sets."""
    for kind in ("cross", "parallel"):
        for name in "abc":
            write_image(folder / "texture_sets" / kind / f"{name}.png", picture())
    return folder


def test_sets_are_read_beside_the_photographs(polarised: Path) -> None:
    capture, _ = read_capture(polarised)
    assert {kind: set(images) for kind, images in capture.texture_sets.items()} == {
        "cross": set("abc"),
        "parallel": set("abc"),
    }
    assert capture.texture_sets["cross"]["a"].shape == (HEIGHT, WIDTH, 3)
    assert "texture_sets/parallel/c.png" in capture.digests
    assert capture.remarks == ()


def test_sets_are_reduced_with_the_photographs(polarised: Path) -> None:
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
        "texture_sets/cross/c.png is damaged",
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
        "texture_sets/Cross polarised/ cannot name a file of the result",
    ),
    "a picture beside the sets": (
        lambda f: write_image(f / "texture_sets/a.png", picture()),
        "texture_sets/a.png lies in no texture set",
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
