"""Identifies the camera that took a picture by the serial number that camera bodies write into their files.

Read are EXIF's BodySerialNumber (CIPA DC-008, tag 0xA431) of JPEG, TIFF, PNG, WebP and HEIC, of RAW files built like
TIFF, and of Canon's CR3 (its box CMT2), and DNG's CameraSerialNumber (0xC62F). A camera of ``cameras.json`` states its
body's serial number as ``serial``, or has it as its name."""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from PIL import Image

from rig.formats.cameras.cameras_json import SERIAL_MOST
from rig.formats.pictures.images import HEIC_SUFFIXES, IMAGE_FORMATS, RAW_SUFFIXES, heif_header, is_picture
from rig.messages.message import Message, compose
from rig.rig import Rig

BODY_SERIAL, DNG_SERIAL, EXIF_IFD = 0xA431, 0xC62F, 0x8769
BYTE_ORDERS = {b"II": b"II*\0", b"MM": b"MM\0*"}  # Olympus and Panasonic write another third byte
CR3_EXIF = re.compile(rb"CMT2(?=II\*\0|MM\0\*)")


def camera_serial(path: Path) -> str | None:
    """Returns the serial number in a picture file; None if there is none or it cannot be read."""
    with suppress(Exception):  # damaged EXIF fails in more ways than Pillow's documentation has
        for tags in _tag_sets(path):
            for tag in (BODY_SERIAL, DNG_SERIAL):
                text = str(tags.get(tag, "")).strip(" \0\t\r\n")
                if 0 < len(text) <= SERIAL_MOST and text.isprintable() and text.strip("0"):
                    return text
    return None


def _tag_sets(path: Path) -> list[Mapping[int, object]]:
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        data = path.read_bytes()
        if inner := CR3_EXIF.search(data, 0, 1 << 20):
            return [_exif(data[inner.end() : inner.end() + (1 << 20)])]
        exif = _exif(BYTE_ORDERS[data[:2]] + data[4:])
    elif suffix in HEIC_SUFFIXES:
        exif = _exif(heif_header(path.read_bytes()).info.get("exif") or b"")
    else:
        with Image.open(path, formats=IMAGE_FORMATS) as header:
            exif = header.getexif()
            return [exif.get_ifd(EXIF_IFD), exif]  # read from the file, which must be open still
    return [exif.get_ifd(EXIF_IFD), exif]


def _exif(data: bytes) -> Image.Exif:
    found = Image.Exif()
    found.load(data)
    return found


def with_serials(rig: Rig, pictures: Mapping[str, Path]) -> Rig:
    """Returns the rig with each camera's ``serial`` read from its picture. Serials that two pictures share are left
    out, since then one body took both."""
    serials = {name: camera_serial(path) for name, path in pictures.items()}
    recorded = [serial for serial in serials.values() if serial is not None]
    unique = {name: serial for name, serial in serials.items() if serial is not None and recorded.count(serial) == 1}
    return replace(rig, cameras=tuple(replace(c, serial=unique.get(c.name, c.serial)) for c in rig))


def pictures_by_serial(folder: Path, rig: Rig, faults: list[Message]) -> dict[str, Path]:
    """Returns pictures of ``folder`` by camera, matched by serial number, for pictures whose names are no camera's.

    Nothing is read if every camera has a picture of its name. Appends a fault for each picture that cannot be matched,
    and for two pictures of one body."""
    here = sorted(path for path in folder.iterdir() if is_picture(path))
    inside = {path.name for path in folder.iterdir() if path.is_dir()}
    lacking = [camera for camera in rig if camera.name not in {path.stem for path in here} | inside]
    strays = [path for path in here if path.stem not in rig]
    bodies = {camera.serial or camera.name: camera.name for camera in lacking}
    if not lacking or not strays:
        return {}
    serials = {path: camera_serial(path) for path in strays}
    if not any(serials.values()) and not any(camera.serial for camera in rig):
        return {}  # an ordinary capture with a picture too many, which others name
    found: dict[str, Path] = {}
    for path, serial in serials.items():
        where = f"{folder.name}/{path.name}"
        if serial is None:
            faults.append(compose("picture-without-serial", picture=where))
        elif serial not in bodies:
            faults.append(compose("picture-of-strange-body", picture=where, serial=serial, cameras=[*bodies]))
        elif bodies[serial] in found:
            other = found[bodies[serial]].name
            faults.append(
                compose("pictures-of-one-body", picture=where, other=other, serial=serial, camera=bodies[serial])
            )
        else:
            found[bodies[serial]] = path
    return found
