"""Pictures that are filed by the serial number of the body that took them, in files as cameras write them."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig, write_rig
from rig.formats.captures.archive import ArchiveLimits, pack_folder
from rig.formats.captures.capture_folder import read_capture
from rig.formats.captures.shot_files import BODY_SERIAL, DNG_SERIAL, EXIF_IFD, camera_serial, with_serials
from rig.messages.message import texts_of
from server.cli.check import checked
from server.tasks.child import WorkerContext
from server.tasks.ingest import ingest_archive
from tests.support.services import small_capture


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
