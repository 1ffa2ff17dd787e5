"""Whose a capture's files are: conventions of other programs are filed, strays are told, one cause is one sentence;
serial numbers of bodies."""

import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.cameras_file import write_rig_file
from rig.formats.cameras.cameras_json import read_rig, write_rig
from rig.formats.captures.archive import ArchiveLimits, pack_folder
from rig.formats.captures.capture_folder import capture_root, read_capture, write_capture
from rig.formats.captures.shot_files import BODY_SERIAL, DNG_SERIAL, EXIF_IFD, camera_serial, find_files, with_serials
from rig.geometry import look_at
from rig.messages.message import texts_of
from rig.rig import Rig
from server.cli.check import checked
from server.tasks.child import WorkerContext
from server.tasks.ingest import ingest_archive
from tests.support.services import small_capture

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
    "masks with a suffix": renamed("masks", lambda name: f"{name}_mask.png"),
    "masks in folders": renamed("masks", lambda name: f"{name}/0001.png"),
    "masks in upper case": renamed("masks", lambda name: f"{name.upper()}.PNG"),
    "plates numbered": renamed("background", lambda name: f"{name}_0001.png"),
    "plates in folders": renamed("background", lambda name: f"{name}/{name}_empty.png"),
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
    assert f": {kind}/DSC_100.png, " in remark.text
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
    assert ": images/cam00.exr has no camera" in strays
    assert unread.endswith(": depth/ is not read: pictures lie in images/, masks/ and background/")
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
    capture, rig = read_capture(folder)
    assert rig.names == rig_of().names
    binary = {"sparse/0/cameras.bin", "sparse/0/images.bin"}  # points and what is not read do not count
    assert {path for path in capture.digests if path.startswith("sparse")} == binary
    assert [remark.text.partition(" is not read: ")[::2] for remark in capture.remarks] == [
        (f"a part of the folder has no effect: {file}", "the cameras come from sparse/0/cameras.bin")
        for file in ("sparse/0/cameras.txt", "sparse/1/cameras.txt")
    ]


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


def photograph(path: Path, serial: str | None, tag: int = BODY_SERIAL) -> Path:
    """A picture of 24 x 24 pixels of noise, with a serial number in its EXIF."""
    exif = Image.Exif()
    exif[0x010F] = "maker"
    if serial is not None:
        (exif if tag == DNG_SERIAL else exif.get_ifd(EXIF_IFD))[tag] = serial
    whole = Image.Exif()
    whole.load(exif.tobytes())  # Pillow writes an inner directory into a TIFF only where it was read from bytes
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng([*str(path).encode()]).integers(0, 256, (24, 24, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, exif=whole)
    return path


def rolling(folder: Path) -> Path:
    """A capture whose pictures and plates are named as cameras count."""
    small_capture(folder)
    rig = read_rig(folder / "cameras.json")
    write_rig(type(rig)(tuple(replace(c, serial=f"00{i}7") for i, c in enumerate(rig))), folder / "cameras.json")
    for kind in ("images", "background"):
        for index in range(3):
            (folder / kind / f"cam{index:02}.png").unlink()
            photograph(folder / kind / f"IMG_{7000 - index}.jpg", f"00{index}7")
    return folder


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp"])
def test_serials_of_ordinary_files_are_read(tmp_path: Path, name: str) -> None:
    assert camera_serial(photograph(tmp_path / name, " 0123-AB ")) == "0123-AB"
    assert camera_serial(photograph(tmp_path / name, None)) is None
    assert camera_serial(photograph(tmp_path / name, "0000000")) is None, "what cameras write that know none"


def test_serials_of_raw_files_are_read(tmp_path: Path) -> None:
    dng = photograph(tmp_path / "a.tif", "4711", DNG_SERIAL).rename(tmp_path / "a.dng")
    assert camera_serial(dng) == "4711"
    tiff = photograph(tmp_path / "b.tif", "4712").read_bytes()
    for suffix, third in ((".orf", b"RO"), (".rw2", b"U\0"), (".nef", tiff[2:4])):
        path = tmp_path / f"b{suffix}"
        path.write_bytes(tiff[:2] + third + tiff[4:])
        assert camera_serial(path) == "4712"
    # CR3's CMT2: a TIFF whose only directory is EXIF's (https://github.com/lclevy/canon_cr3)
    text = b"4713\0\0\0\0"
    box = b"II*\0" + struct.pack("<IHHHII", 8, 1, BODY_SERIAL, 2, len(text), 26) + struct.pack("<I", 0) + text
    (tmp_path / "c.cr3").write_bytes(struct.pack(">I", 24) + b"ftypcrx " + bytes(12) + b"\0\0\0\x30CMT2" + box)
    assert camera_serial(tmp_path / "c.cr3") == "4713"
    (tmp_path / "d.cr3").write_bytes(b"CMT2II*\0\xff\xff\xff")
    assert camera_serial(tmp_path / "d.cr3") is None


def test_pictures_are_filed_by_their_bodies(tmp_path: Path) -> None:
    capture, rig = read_capture(rolling(tmp_path / "shot"))
    assert set(capture.images) == set(capture.backgrounds) == set(rig.names)
    assert {"images/IMG_7000.jpg", "background/IMG_6998.jpg"} <= capture.digests.keys()
    assert checked(tmp_path / "shot", {}, report=lambda *_: None)["cameras"] == list(rig.names)
    pack_folder(tmp_path / "shot", tmp_path / "shot.tar")
    (tmp_path / "in" / "files").mkdir(parents=True)
    content = ingest_archive(
        WorkerContext(), lambda *_: None, archive=str(tmp_path / "shot.tar"), folder=str(tmp_path / "in" / "files"),
        limits=ArchiveLimits(members=100, total_bytes=10**7, ratio=100.0), image_pixels=10**8,
    )  # fmt: skip
    assert {f"{kind}/cam0{i}.jpg" for kind in ("images", "background") for i in range(3)} <= content.inputs.keys()


def test_a_camera_may_have_its_serial_for_a_name(tmp_path: Path) -> None:
    folder = rolling(tmp_path / "shot")
    rig = read_rig(folder / "cameras.json")
    named = type(rig)(tuple(replace(c, name=str(c.serial), serial=None) for c in rig))
    write_rig(named, folder / "cameras.json")
    assert set(read_capture(folder)[0].images) == {"0007", "0017", "0027"}


def test_what_cannot_be_filed_is_named(tmp_path: Path) -> None:
    folder = rolling(tmp_path / "shot")
    photograph(folder / "images" / "IMG_6999.jpg", None)
    photograph(folder / "images" / "IMG_6998.jpg", "0007")
    photograph(folder / "background" / "IMG_6998.jpg", "999")
    with pytest.raises(InputError) as refused:
        read_capture(folder)
    faults = "; ".join(texts_of(refused.value.faults))
    for words in (
        "images/IMG_6999.jpg is no camera's name, and its EXIF has no serial number: name it after its camera",
        "images/IMG_7000.jpg and IMG_6998.jpg were both taken by the camera body 0007 (cam00): keep one",
        "background/IMG_6998.jpg was taken by the body 999, and cameras without a picture are 0007, 0017, 0027",
        "images/cam01.png is missing",
    ):
        assert words in faults
    assert checked(folder, {}, report=lambda *_: None)["faults"]
    document = (folder / "cameras.json").read_text()
    (folder / "cameras.json").write_text(document.replace('"0017"', '"0007"'))
    with pytest.raises(InputError, match="cam00, cam01 have the same serial number '0007', but each camera has"):
        read_capture(folder)


def test_calibrations_write_serials_unless_one_body_took_all(tmp_path: Path) -> None:
    rig = read_rig(small_capture(tmp_path / "shot") / "cameras.json")
    one = {name: photograph(tmp_path / f"{name}.jpg", "0007") for name in rig.names}
    assert [camera.serial for camera in with_serials(rig, one)] == [None] * 3
    each = {name: photograph(tmp_path / f"{name}.jpg", f"00{i}7") for i, name in enumerate(rig.names)}
    write_rig(with_serials(rig, each), tmp_path / "cameras.json")
    assert [camera.serial for camera in read_rig(tmp_path / "cameras.json")] == ["0007", "0017", "0027"]
