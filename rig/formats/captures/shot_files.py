"""Finds each camera's picture, mask and clean plates in a capture folder.

A file with the name of a camera belongs to that camera. If a camera has no such file, a similar name is accepted if it
fits only one camera (``rig.formats.pictures.picture_names``). If no name matches, the camera body's serial number in
the file decides. A camera body's serial number is EXIF's BodySerialNumber (CIPA DC-008, tag 0xA431), for Canon's CR3 in
its box CMT2, or DNG's CameraSerialNumber (0xC62F). Pictures may also lie in a folder with the camera's name, and all
folders in one enclosing folder."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from PIL import Image

from rig.capture import TEXTURE_SETS
from rig.formats.cameras.cameras_json import SERIAL_MOST
from rig.formats.pictures.images import HEIC_SUFFIXES, IMAGE_FORMATS, RAW_SUFFIXES, heif_header, is_picture
from rig.formats.pictures.picture_names import (
    UNREAD_PICTURES,
    entry,
    has_raw_beside,
    is_junk,
    match_names,
    picture_stem,
)
from rig.messages.message import Message, compose, some_of
from rig.rig import Rig

BODY_SERIAL, DNG_SERIAL, EXIF_IFD = 0xA431, 0xC62F, 0x8769
BYTE_ORDERS = {b"II": b"II*\0", b"MM": b"MM\0*"}  # Olympus and Panasonic write another third byte
CR3_EXIF = re.compile(rb"CMT2(?=II\*\0|MM\0\*)")
PLATES_MOST = 32  # clean plates read per camera
BESIDE_PICTURES = ("masks", "background")  # folders of a capture that belong to no single camera
ASIDE = (*BESIDE_PICTURES, TEXTURE_SETS)  # folders beside the pictures that are no camera's
SETS_MOST = 8  # texture sets of a capture: every one is as large as its photographs
SET_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
NAME_SHOWN = 60  # characters of a name that is too long


def camera_serial(path: Path) -> str | None:
    """Returns the camera's serial number in a picture file, or None without a readable number."""
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
    """Returns the rig with each camera's ``serial`` read from its picture. A serial number in two pictures is omitted,
    because it does not identify one camera."""
    serials = {name: camera_serial(path) for name, path in pictures.items()}
    recorded = [serial for serial in serials.values() if serial is not None]
    unique = {name: serial for name, serial in serials.items() if serial is not None and recorded.count(serial) == 1}
    return replace(rig, cameras=tuple(replace(c, serial=unique.get(c.name, c.serial)) for c in rig))


def pictures_by_serial(folder: Path, rig: Rig, faults: list[Message]) -> dict[str, Path]:
    """Matches pictures of ``folder`` to cameras by serial number. Returns the matched pictures by camera.

    If every camera has a picture with its name, reads no file. Appends a fault for each unmatched picture, and for two
    pictures by one camera body."""
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


@dataclass(frozen=True, slots=True)
class ShotFiles:
    """Holds the files of a shot by camera. ``strays`` lists pictures that match no camera, relative to the capture's
    folder. ``faults`` holds messages about missing or ambiguous files. ``texture_sets`` holds files by set and camera.
    ``absent`` reports, by camera, a file that only this camera lacks."""

    images: Mapping[str, Path]
    masks: Mapping[str, Path]
    plates: Mapping[str, tuple[Path, ...]]
    strays: tuple[str, ...]
    faults: tuple[Message, ...]
    texture_sets: Mapping[str, Mapping[str, Path]] = field(default_factory=dict)
    absent: Mapping[str, Message] = field(default_factory=dict)

    def of_camera(self, name: str) -> list[tuple[str, Path]]:
        """Returns the kind (its folder's path in the capture) and the path of each file of a camera."""
        found = [("images", self.images.get(name)), ("masks", self.masks.get(name))]
        found += [("background", plate) for plate in self.plates.get(name, ())]
        found += [(f"{TEXTURE_SETS}/{kind}", files.get(name)) for kind, files in self.texture_sets.items()]
        return [(kind, path) for kind, path in found if path is not None]


def find_files(folder: Path, rig: Rig, left_out: Iterable[str] = ()) -> ShotFiles:
    """Finds the files of one shot. Ignores the files of the excluded cameras ``left_out``."""
    names, faults = [*rig.names, *left_out], list[Message]()
    places = {"images": picture_folder(folder), **{kind: entry(folder, kind) for kind in BESIDE_PICTURES}}
    owned = {kind: _owned(place, names, kind, rig, faults) for kind, place in places.items()}
    images = {name: path for name in rig.names if (path := _one(owned["images"].get(name, []), folder, faults))}
    masks = {name: path for name in rig.names if (path := _one(owned["masks"].get(name, []), folder, faults))}
    plates = {
        name: tuple(listed_plates)
        for name in rig.names
        if (listed_plates := _flat(owned["background"].get(name, []))[:PLATES_MOST])
    }
    used = {path for kind in owned.values() for paths in kind.values() for path in _flat(paths)}
    strays = {kind: _strays(place, used, names, kind) for kind, place in places.items()}
    missing, absent, cause = _missing(folder, rig, images, masks, plates, places=places, strays=strays)
    if places["images"] != folder:
        strays["beside"] = [path for path in listed_pictures(folder) if path not in used]
    stray_names = [path.relative_to(folder).as_posix() for paths in strays.values() for path in paths]
    if stray_names or missing or faults or len(absent) == len(rig):  # one of the others may be what is missing
        missing, absent = [*absent.values(), *missing], {}
    faults += missing + ([stray_sentence(stray_names, rig)] if missing and stray_names and not cause else [])
    sets = _texture_sets(folder, rig, names, faults)
    return ShotFiles(images, masks, plates, tuple(stray_names), tuple(faults), sets, absent)


def _texture_sets(folder: Path, rig: Rig, names: Sequence[str], faults: list[Message]) -> dict[str, dict[str, Path]]:
    """Returns the pictures of each texture set by camera. A set's name must be lower case."""
    place = entry(folder, TEXTURE_SETS)
    if not place.is_dir():
        return {}
    if alone := [path.relative_to(folder).as_posix() for path in sorted(place.iterdir()) if shows_something(path)]:
        faults.append(compose("texture-set-unnamed", pictures=some_of(alone), count=len(alone)))
    folders = _folders(place)
    if len(folders) > SETS_MOST:
        faults.append(compose("texture-sets-many", count=len(folders), most=SETS_MOST))
        return {}
    found = {}
    for path in folders:
        if SET_NAME.fullmatch(path.name):
            found[path.name] = _texture_set(folder, path, rig, names, faults)
        else:
            faults.append(compose("texture-set-misnamed", folder=f"{TEXTURE_SETS}/{path.name[:NAME_SHOWN]}"))
    return found


def _texture_set(folder: Path, place: Path, rig: Rig, names: Sequence[str], faults: list[Message]) -> dict[str, Path]:
    """Returns the pictures of one texture set by camera. Appends a fault unless each camera has one picture."""
    where = place.relative_to(folder).as_posix()
    owned = _owned(place, names, TEXTURE_SETS, rig, faults)
    pictures = {name: path for name in rig.names if (path := _one(owned.get(name, []), folder, faults))}
    strays = _strays(place, {path for paths in owned.values() for path in _flat(paths)}, names, TEXTURE_SETS)
    lacking = [name for name in rig.names if name not in pictures and name not in owned]
    unread = {name: fault for name in lacking if (fault := _of_other_kind(name, folder, strays))}
    faults += unread.values()
    if absent := [name for name in lacking if name not in unread]:
        faults.append(compose("texture-set-incomplete", folder=where, cameras=some_of(absent), count=len(absent)))
    strange = [path.relative_to(folder).as_posix() for path in strays if picture_stem(path.name) not in unread]
    if strange:
        faults.append(stray_sentence(strange, rig))
    return pictures


def picture_folder(folder: Path) -> Path:
    """Returns the folder of a capture's photographs: images/ if it exists, otherwise the capture folder."""
    return images if (images := entry(folder, "images")).is_dir() else folder


def listed_pictures(folder: Path) -> list[Path]:
    """Returns the sorted pictures in a folder, or an empty list if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if is_picture(path) and not has_raw_beside(path))


def stray_sentence(strays: Sequence[str], rig: Rig) -> Message:
    """Returns a message that lists the pictures that match no camera."""
    return compose("pictures-strange", count=len(strays), pictures=some_of(strays), cameras=rig.names)


def _owned(place: Path, names: Sequence[str], kind: str, rig: Rig, faults: list[Message]) -> dict[str, list[Path]]:
    """Returns the files and folders of each camera in ``place``, a folder of the capture."""
    if not place.is_dir():
        return {}
    inner = _unwrapped(place, names)
    pictures = listed_pictures(inner)
    beside = () if kind != "images" or inner != place or place.name.lower() == "images" else ASIDE
    folders = [path for path in _folders(inner) if path.name.lower() not in beside and listed_pictures(path)]
    found: dict[str, list[Path]] = {}
    for path in [*pictures, *folders]:
        camera = path.stem if path in pictures and path.stem in names else path.name
        if camera in names:
            found.setdefault(camera, []).append(path)
    paths = {path.name: path for path in [*pictures, *folders]}
    spelled = match_names(paths, names, several=kind == "background")
    found |= {name: [paths[file] for file in camera] for name, camera in spelled.items()}
    if not spelled and kind != "masks":
        found |= {name: [path] for name, path in pictures_by_serial(inner, rig, faults).items()}
    return found


def _unwrapped(place: Path, names: Sequence[str]) -> Path:
    """Returns the only folder inside ``place``, as in ``images/shot01/cam00.png``, if it belongs to no camera and
    ``place`` has no pictures. Otherwise returns ``place``."""
    folders = [path for path in _folders(place) if path.name.lower() not in (*BESIDE_PICTURES, "images")]
    alone = len(folders) == 1 and not listed_pictures(place) and place.name.lower() in ("images", *BESIDE_PICTURES)
    alone = alone and not match_names([folders[0].name], names) and folders[0].name not in names
    return folders[0] if alone and len(listed_pictures(folders[0])) > 1 else place


def _folders(place: Path) -> list[Path]:
    return sorted(path for path in place.iterdir() if path.is_dir() and not is_junk(path.name))


def _one(paths: Sequence[Path], root: Path, faults: list[Message]) -> Path | None:
    """Returns a camera's only picture or mask, which may lie in a folder. Appends a fault if the camera has several."""
    files = [path for path in paths if path.is_file()]
    if len(files) > 1:
        where = files[0].parent.relative_to(root).as_posix()
        faults.append(compose("pictures-of-one-camera", folder=where, pictures=[path.name for path in files]))
    if files:
        return files[0]
    inside = _flat(paths)
    if len(inside) > 1:
        faults.append(compose("pictures-in-camera-folder", folder=paths[0].name, count=len(inside)))
    return inside[0] if inside else None


def _flat(paths: Sequence[Path]) -> list[Path]:
    """Returns the files in ``paths``, and the pictures inside the folders in ``paths``."""
    return [path for entry in paths for path in (listed_pictures(entry) if entry.is_dir() else [entry])]


def _strays(place: Path, used: set[Path], names: Sequence[str], kind: str) -> list[Path]:
    """Returns pictures in a folder of the capture that match no camera, unsupported formats included."""
    if not place.is_dir():
        return []
    is_root = kind == "images" and place.name.lower() != "images"
    folders = [place, *(path for path in _folders(place) if not is_root or path.name in names)]
    here = [path for folder in folders for path in sorted(folder.iterdir()) if shows_something(path)]
    return [path for path in here if path not in used and not (is_root and path.suffix.lower() in (".pdf", ".npy"))]


def shows_something(path: Path) -> bool:
    """Returns whether a path is a picture, perhaps in an unsupported format, without a RAW file of the same picture."""
    if has_raw_beside(path):
        return False
    return is_picture(path) or (path.suffix.lower() in UNREAD_PICTURES and not is_junk(path.name) and path.is_file())


def _missing(
    folder: Path,
    rig: Rig,
    images: Mapping[str, Path],
    masks: Mapping[str, Path],
    plates: Mapping[str, tuple[Path, ...]],
    *,
    places: Mapping[str, Path],
    strays: Mapping[str, Sequence[Path]],
) -> tuple[list[Message], dict[str, Message], bool]:
    """Returns faults about missing files, the missing file of individual cameras, and whether the faults name the
    unmatched pictures.

    If no camera has a file but unmatched files exist, one message reports the common cause."""
    inside = "" if places["images"] == folder else "images/"
    faults, alone, named = list[Message](), not any(entry(folder, kind).is_dir() for kind in BESIDE_PICTURES), False
    absent: dict[str, Message] = {}
    lacking = [name for name in rig.names if name not in images]
    if cause := _cause(rig, lacking, strays["images"], inside or compose("the-folder"), compose("a-picture")):
        faults.append(cause)
        named = True
    else:
        for name in lacking:
            other = _of_other_kind(name, folder, strays["images"])
            if other is not None:
                named = True
                faults.append(other)
            elif link := _broken_link(places["images"], name):
                where, target = link.relative_to(folder).as_posix(), link.readlink().as_posix()
                absent[name] = compose("picture-link-broken", picture=where, target=target)
            elif (places["images"] / name).is_file():
                absent[name] = compose("picture-kind-unread", picture=f"{inside}{name}", kind="endingless")
            else:
                absent[name] = compose("picture-missing", picture=f"{inside}{name}.png")
    lacking = [] if alone else [name for name in rig.names if name not in plates and name not in masks]
    cause = _cause(rig, lacking, strays["masks"], "masks/", compose("a-mask"))
    cause = cause or _cause(rig, lacking, strays["background"], "background/", compose("a-clean-plate"))
    for name in () if cause else lacking:
        other = _of_other_kind(name, folder, [*strays["masks"], *strays["background"]])
        named = named or other is not None
        if other is None:
            absent.setdefault(name, compose("plate-missing", camera=name))
        else:
            faults.append(other)
    return [*faults, *([cause] if cause else [])], absent, named or bool(cause)


def _of_other_kind(name: str, folder: Path, strays: Sequence[Path]) -> Message | None:
    """Returns a fault if a camera's file exists only in an unsupported format; otherwise None."""
    for path in strays:
        kind = UNREAD_PICTURES.get(path.suffix.lower())
        if kind is not None and picture_stem(path.name) == name:
            return compose("picture-kind-unread", picture=path.relative_to(folder).as_posix(), kind=kind)
    return None


def _broken_link(place: Path, name: str) -> Path | None:
    """Returns a broken symbolic link with the camera's name, or None."""
    links = (path for path in sorted(place.iterdir()) if path.is_symlink() and not path.exists())
    return next((path for path in links if picture_stem(path.name) == name), None)


def _cause(
    rig: Rig, lacking: Sequence[str], strays: Sequence[Path], place: str | Message, what: Message
) -> Message | None:
    """Returns one message if all cameras lack a file and at least as many unmatched files exist; otherwise None."""
    strangers = [path for path in strays if is_picture(path)]
    if not len(lacking) == len(rig) > 1 or len(strangers) < max(len(lacking), 2):
        return None
    cameras = compose("first-to-last", first=rig.names[0], last=rig.names[-1])
    parents = sorted({path.parent.name for path in strangers})
    if len(parents) > 1 and len({path.name for path in strangers}) < len(strangers):
        return compose("shots-in-folders", what=what, place=place, folders=some_of(parents), cameras=cameras)
    found = compose("first-to-last", first=strangers[0].name, last=strangers[-1].name)
    doubt = _doubt(strangers, rig) or compose("rename-either")
    return compose("names-differ", what=what, place=place, cameras=cameras, found=found, remedy=doubt)


def _doubt(strangers: Sequence[Path], rig: Rig) -> Message | None:
    """Returns a message if several file names contain each camera's name, so that they are ambiguous."""
    several = match_names([path.name for path in strangers], rig.names, several=True)
    if len(several) < len(rig) or all(len(pictures) == 1 for pictures in several.values()):
        return None
    pictures = several[rig.names[0]]
    return compose("several-of-each", camera=rig.names[0], count=len(pictures), files=some_of(pictures, 2))
