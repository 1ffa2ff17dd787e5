"""Whose picture a file is by its name alone: what leaves no doubt is filed, what leaves one is not."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.formats.pictures.picture_names import is_junk, match_names, picture_stem

CAMERAS = [f"cam{i:02}" for i in range(11)]
ALL_OF_ONE = [
    "{0}.png.png",  # COLMAP
    "{0}.jpg.png",  # of a jpg picture
    "{0}.png.mask.png",  # RealityScan
    "{0}_mask.png",
    "{0}-Mask.PNG",
    "mask_{0}.tif",
    "{0}_bg.png",
    "shot.0001.{0}.tif",
    "2024-11-25_10-30-59_{0}.jpg",
    "IMG_0001_{0}_RGB.JPEG",
    "{0} (1).png",
]


@pytest.mark.parametrize("pattern", ALL_OF_ONE)
def test_what_all_files_have_beside_their_cameras_names_does_not_count(pattern: str) -> None:
    found = match_names([pattern.format(name) for name in CAMERAS], CAMERAS)
    assert found == {name: [pattern.format(name)] for name in CAMERAS}


@pytest.mark.parametrize("pattern", ["cam{0}.png", "CAM_{0:02}.PNG", "Cam-{0:03}.png", "{0:02}.png", "{0}.bmp"])
def test_signs_case_and_leading_zeros_do_not_count(pattern: str) -> None:
    found = match_names([pattern.format(i) for i in range(10)], CAMERAS[:10])
    assert found == {name: [pattern.format(i)] for i, name in enumerate(CAMERAS[:10])}


def test_names_that_vary_are_filed_where_each_names_one_camera_or_several_may_be() -> None:
    names = [f"{name}_{1000 + 7 * i}.png" for i, name in enumerate(CAMERAS)]
    assert match_names(names, CAMERAS) == {name: [file] for name, file in zip(CAMERAS, names, strict=True)}
    names = [f"{name}_{shot:03}.png" for name in CAMERAS for shot in (1, 2, 3)]
    assert match_names(names, CAMERAS) == {}
    found = match_names(names, CAMERAS, several=True)
    assert found == {name: [f"{name}_{shot:03}.png" for shot in (1, 2, 3)] for name in CAMERAS}


@pytest.mark.parametrize(
    "names",
    [
        [f"IMG_{i:04}.png" for i in range(11)],  # counters of shots
        [f"{i}.png" for i in range(1, 12)],  # from 1, not 0
        [f"{name}_{shot}.png" for name in CAMERAS for shot in (1, 2)],  # two shots
        [f"camera{i:02}.png" for i in range(11)],  # another word: perhaps another rig's
        [f"cam{i:02}x.png" for i in range(11, 22)],
        ["cam00_cam01.png"],  # a pair's
        ["cam00_cam01_3.png", "cam01_cam02_4.png"],
        ["DSC01.png"],
        ["---.png"],
    ],
)
def test_what_leaves_a_doubt_is_nobody_s(names: list[str]) -> None:
    assert match_names(names, CAMERAS) == {}


@pytest.mark.parametrize(
    ("names", "cameras", "found"),
    [
        (["cam01.png", "cam01_old.png", "cam02_new.png"], CAMERAS, {"cam02": ["cam02_new.png"]}),
        (["IMG_2.png"], ["1", "2", "3", "11"], {}),  # may be a counter
        (["CAM.png"], ["cam", "Cam"], {}),
        (
            ["shot_2_cam_2.png", "shot_2_cam_11.png"],
            ["2", "11"],
            {"2": ["shot_2_cam_2.png"], "11": ["shot_2_cam_11.png"]},
        ),
        (["a_left_top", "b_left"], ["left", "left top"], {"left top": ["a_left_top"], "left": ["b_left"]}),
    ],
    ids=["one has a file of its name", "a counter", "case alone", "numbers beside a word", "the longest name"],
)
def test_a_name_is_one_camera_s_or_nobody_s(names: list[str], cameras: list[str], found: dict[str, list[str]]) -> None:
    assert match_names(names, cameras) == found


def test_only_endings_of_pictures_are_taken_off() -> None:
    for name, stem in [
        ("cam.01", "cam.01"),
        ("cam.01.TIF", "cam.01"),
        ("2024.11.25_cam00", "2024.11.25_cam00"),
        ("frame.0001", "frame.0001"),
        ("a.jp2", "a"),
        (".png", ".png"),
        ("cam00.png.png", "cam00.png"),
    ]:
        assert picture_stem(name) == stem


def test_what_file_managers_add_is_junk() -> None:
    assert all(
        is_junk(name) for name in ("Thumbs.db", "thumbs.db", ".DS_Store", "__MACOSX", "._cam00.png", "desktop.ini")
    )
    assert not any(is_junk(name) for name in ("cam00.png", "images", "db"))


@given(st.lists(st.text(max_size=12), max_size=8), st.lists(st.text(min_size=1, max_size=6), max_size=6, unique=True))
def test_no_file_is_given_twice_and_none_to_a_camera_that_has_one(names: list[str], cameras: list[str]) -> None:
    found = match_names(names, cameras)
    given_away = [name for files in found.values() for name in files]
    assert len(given_away) == len(set(given_away)) == len(found)
    assert set(given_away) <= set(names)
    assert not set(found) & {picture_stem(name) for name in names}
