"""Whose a capture's files are: conventions of other programs are filed, strays are told, one cause is one sentence."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.cameras_file import write_rig_file
from rig.formats.captures.capture_folder import capture_root, read_capture, write_capture
from rig.formats.captures.shot_files import find_files
from rig.geometry import look_at
from rig.messages.message import texts_of
from rig.rig import Rig

HEIGHT, WIDTH, COUNT = 48, 64, 5


def rig_of(count: int = COUNT) -> Rig:
    intrinsics = Intrinsics(WIDTH, HEIGHT, 90.0, 90.0, 31.5, 23.5)
    cameras = []
    for i, angle in enumerate(np.linspace(-1, 1, count)):
        pose = look_at(np.array([900 * np.sin(angle), 0, 900 * np.cos(angle)]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        cameras.append(Camera(f"cam{i:02}", intrinsics, pose))
    return Rig(tuple(cameras))


def shot_of(rig: Rig) -> Capture:
    """Every file has pixels of its own, so that it is known again."""
    rng = np.random.default_rng(0)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    pictures = {name: rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for name in rig.names}
    plates = {name: (rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),) for name in rig.names}
    masks = {}
    for i, name in enumerate(rig.names):
        masks[name] = mask.copy()
        masks[name][10 : 30 + i, 20:40] = True
    return Capture(pictures, plates, masks)


SHOT = shot_of(rig_of())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_capture(tmp_path / "shot", SHOT, rig_of())
    return tmp_path / "shot"


def renamed(kind: str, name: Callable[[str], str]) -> Callable[[Path], None]:
    def rename(folder: Path) -> None:
        for path in sorted((folder / kind).iterdir()):
            target = folder / kind / name(path.stem)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.rename(target)

    return rename


def as_format(kind: str, ending: str) -> Callable[[Path], None]:
    def convert(folder: Path) -> None:
        for path in sorted((folder / kind).iterdir()):
            cv2.imwrite(str(path.with_suffix(ending)), np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
            path.unlink()

    return convert


WAYS: dict[str, Callable[[Path], None]] = {
    "masks as COLMAP's": renamed("masks", lambda name: f"{name}.png.png"),
    "masks as COLMAP's of jpg": renamed("masks", lambda name: f"{name}.JPG.png"),
    "masks as RealityScan's": renamed("masks", lambda name: f"{name}.png.mask.png"),
    "masks with a suffix": renamed("masks", lambda name: f"{name}_mask.png"),
    "masks with a prefix": renamed("masks", lambda name: f"mask-{name}.png"),
    "masks in folders": renamed("masks", lambda name: f"{name}/0001.png"),
    "masks in upper case": renamed("masks", lambda name: f"{name.upper()}.PNG"),
    "plates with a suffix": renamed("background", lambda name: f"{name}_bg.png"),
    "plates numbered": renamed("background", lambda name: f"{name}_0001.png"),
    "plates in folders": renamed("background", lambda name: f"{name}/{name}_empty.png"),
    "pictures with a suffix": renamed("images", lambda name: f"{name}_0001.png"),
    "pictures with dots": renamed("images", lambda name: f"shot.0001.{name}.png"),
    "pictures in folders": renamed("images", lambda name: f"{name.upper()}/IMG_7.png"),
    "pictures in a folder of the shot": renamed("images", lambda name: f"shot 01/{name}.png"),
    "numbers alone": renamed("images", lambda name: f"{int(name[3:])}.png"),
    "pictures as BMP": as_format("images", ".bmp"),
    "plates as PPM": as_format("background", ".ppm"),
    "masks as PGM": as_format("masks", ".pgm"),
    "masks as BMP": as_format("masks", ".BMP"),
}


@pytest.mark.parametrize("way", WAYS)
def test_files_in_the_names_of_other_programs_are_filed(way: str, folder: Path) -> None:
    WAYS[way](folder)
    capture, rig = read_capture(folder)
    assert capture.remarks == ()
    for name in rig.names:
        np.testing.assert_array_equal(capture.images[name], SHOT.images[name])
        np.testing.assert_array_equal(capture.masks[name], SHOT.masks[name])
        np.testing.assert_array_equal(capture.backgrounds[name][0], SHOT.backgrounds[name][0])


def test_all_plates_of_a_numbered_series_are_a_camera_s(folder: Path) -> None:
    for path in sorted((folder / "background").iterdir()):
        for number in (1, 2):
            shutil.copy(path, path.with_name(f"{path.stem}_{number:04}.png"))
        path.unlink()
    capture, _ = read_capture(folder)
    assert {len(plates) for plates in capture.backgrounds.values()} == {2}


def only_fault(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    (fault,) = caught.value.faults
    return fault.text


def test_two_shots_in_one_folder_are_one_sentence(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir()):
        shutil.copy(path, path.with_name(f"{path.stem}_0001.png"))
        path.rename(path.with_name(f"{path.stem}_0002.png"))
    fault = only_fault(folder)
    assert "cam00 has 2 (cam00_0001.png, cam00_0002.png): a capture is one shot, leave one of each camera" in fault


def test_two_folders_of_shots_are_one_sentence(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir()):
        for shot in ("morning", "evening"):
            (folder / "images" / shot).mkdir(exist_ok=True)
            shutil.copy(path, folder / "images" / shot / path.name)
        path.unlink()
    assert "it holds the folders evening, morning" in only_fault(folder)


def test_masks_that_nobody_can_file_are_one_sentence_with_the_remedy(folder: Path) -> None:
    shutil.rmtree(folder / "background")
    for number, path in enumerate(sorted((folder / "masks").iterdir())):
        path.rename(path.with_name(f"DSC_{number + 100}.png"))
    fault = only_fault(folder)
    assert fault == (
        "no mask in masks/ fits a camera: the cameras are named cam00 to cam04, the files DSC_100.png to DSC_104.png; "
        "rename either"
    )


def test_what_may_be_what_is_missing_is_told_beside_it(folder: Path) -> None:
    shutil.rmtree(folder / "background")
    (folder / "masks" / "cam03.png").rename(folder / "masks" / "kam03.png")
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert tuple(texts_of(caught.value.faults)) == (
        "background/cam03.png is missing: a clean plate, or masks/cam03.png, is needed",
        "masks/kam03.png has no camera: the rig has cam00, cam01, cam02, cam03, cam04",
    )


@pytest.mark.parametrize("kind", ["masks", "background"])
def test_strays_beside_what_is_used_are_told(kind: str, folder: Path) -> None:
    for number, path in enumerate(sorted((folder / kind).iterdir())):
        path.rename(path.with_name(f"DSC_{number + 100}.png"))
    capture, _ = read_capture(folder)
    (remark,) = capture.remarks
    assert remark.code == "file-unread"
    assert remark.text.startswith(f"{kind}/DSC_100.png, ")
    assert "and 1 more have no camera: the rig has cam00, cam01, cam02, cam03, cam04" in remark.text


def test_pictures_of_cameras_that_the_file_lacks_are_told(folder: Path) -> None:
    write_rig_file(rig_of().subset(["cam00", "cam02", "cam04"]), folder / "cameras.json", "eigenhead")
    messages = [remark.text for remark in read_capture(folder)[0].remarks]
    assert len(messages) == 1
    assert "images/cam01.png, images/cam03.png, masks/cam01.png" in messages[0]


def test_files_of_cameras_that_are_switched_off_are_no_strays(folder: Path) -> None:
    (folder / "cameras.json").unlink()
    write_rig_file(rig_of(), folder / "cameras.xml", "metashape")
    text = (folder / "cameras.xml").read_text()
    (folder / "cameras.xml").write_text(text.replace('label="cam01">', 'label="cam01" enabled="0">'))
    capture, rig = read_capture(folder)
    assert "cam01" not in rig
    (remark,) = capture.remarks
    assert remark.code == "view-left-out"


@pytest.mark.parametrize("name", ["Thumbs.db", ".DS_Store", "._cam00.png", "desktop.ini", "notes.txt", "cam00.xmp"])
def test_what_is_no_picture_is_not_spoken_of(name: str, folder: Path) -> None:
    for kind in ("images", "masks", "background"):
        (folder / kind / name).write_bytes(b"x")
    (folder.parent / "Thumbs.db").write_bytes(b"x")
    assert read_capture(folder.parent)[0].remarks == ()


@pytest.mark.parametrize(
    ("ending", "kind"), [(".gif", "GIF"), (".exr", "OpenEXR"), (".jp2", "JPEG 2000"), (".AVIF", "AVIF")]
)
def test_pictures_that_are_not_read_are_called_what_they_are(ending: str, kind: str, folder: Path) -> None:
    for path in [*(folder / "images").iterdir()]:
        path.rename(path.with_suffix(ending))
    fault = only_fault(folder)
    assert fault.startswith(f"images/cam00{ending} is not read: {kind} files are not supported; save it as PNG")
    assert "the same is true of 4 more (cam01, cam02, cam03, cam04)" in fault


def test_files_of_another_kind_and_folders_of_pictures_that_nobody_reads_are_told(folder: Path) -> None:
    shutil.copytree(folder / "images", folder / "depth")
    (folder / "images" / "cam00.exr").write_bytes(b"v/1")
    strays, unread = (remark.text for remark in read_capture(folder)[0].remarks)
    assert strays.startswith("images/cam00.exr has no camera")
    assert unread == "depth/ is not read: pictures lie in images/, masks/ and background/"
    (folder / "images").rename(folder / "Bilder")
    with pytest.raises(InputError, match="Bilder/ is not read: pictures lie in images/"):
        read_capture(folder)


@pytest.mark.parametrize("around", ["anna", "anna/anna", "anna/2024/shot"])
def test_folders_around_a_capture_do_not_matter(around: str, folder: Path) -> None:
    outer = folder.parent / "outer"
    (outer / around).parent.mkdir(parents=True)
    folder.rename(outer / around)
    (outer / "desktop.ini").write_text("")
    assert capture_root(outer) == outer / around
    assert set(read_capture(outer)[0].images) == set(rig_of().names)


def test_colmap_models_that_are_not_read_are_told(folder: Path) -> None:
    (folder / "cameras.json").unlink()
    write_rig_file(rig_of(), folder / "sparse/0", "colmap")
    write_rig_file(rig_of(), folder / "sparse/0", "colmap-text")
    write_rig_file(rig_of(3), folder / "sparse/1", "colmap-text")
    remarks = [remark.text for remark in read_capture(folder)[0].remarks]
    unread = "cameras.txt is not read: the cameras come from sparse/0/cameras.bin"
    assert remarks == [f"sparse/0/{unread}", f"sparse/1/{unread}"]


def test_one_size_that_is_wrong_everywhere_is_one_sentence(folder: Path) -> None:
    rig = rig_of()
    larger = Rig(tuple(replace(c, intrinsics=replace(c.intrinsics, width=2 * WIDTH, height=2 * HEIGHT)) for c in rig))
    write_rig_file(larger, folder / "cameras.json", "eigenhead")
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    faults = [fault.text for fault in caught.value.faults]
    assert sum("pixels, but its camera is" in fault for fault in faults) <= 3, "one a folder"
    assert any("the same is true of 4 more (" in fault for fault in faults)


def test_files_are_found_without_reading_one(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        path.write_bytes(b"")
    files = find_files(folder, rig_of())
    assert (files.faults, files.strays) == ((), ())
    assert [kind for kind, _ in files.of_camera("cam03")] == ["images", "masks", "background"]
