"""Lists the suffixes of picture files, and matches files to cameras by file names.

The mask of "cam00.png" may be named "cam00.png.png" (COLMAP), "cam00.png.mask.png" (RealityScan) or "cam00_mask.png",
and a picture of "cam00" may be named "shot_0001_cam00.tif". File names are therefore split into words: runs of letters,
and numbers without leading zeros. Separators, case and suffixes of picture names are ignored."""

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from rig.errors import InputError
from rig.messages.message import compose

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
HEIC_SUFFIXES = (".heic", ".heif")
# Uncompressed files of machine vision software: Windows bitmaps, and Netpbm's grey and colour maps.
PLAIN_SUFFIXES = (".bmp", ".pbm", ".pgm", ".ppm", ".pnm")
JPEG_SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif")
IMAGE_SUFFIXES = (".png", *JPEG_SUFFIXES, ".tif", ".tiff", ".webp", *PLAIN_SUFFIXES, *RAW_SUFFIXES, *HEIC_SUFFIXES)
UNREAD_PICTURES = {
    ".gif": "GIF",
    ".exr": "OpenEXR",
    ".hdr": "Radiance HDR",
    ".pfm": "PFM",
    ".avif": "AVIF",
    ".jxl": "JPEG XL",
    ".jp2": "JPEG 2000",
    ".j2k": "JPEG 2000",
    ".tga": "Targa",
    ".psd": "Photoshop",
    ".svg": "SVG",
    ".pdf": "PDF",
    ".npy": "NumPy",
    ".raw": "raw-pixel",
    ".iiq": "Phase One RAW",
    ".3fr": "Hasselblad RAW",
    ".fff": "Hasselblad RAW",
    ".nrw": "Nikon NRW",
    ".x3f": "Sigma RAW",
    ".mp4": "video",
    ".mov": "video",
    ".avi": "video",
}
"""What pictures are kept in and nobody here reads, by ending: such a file is called what it is, not missing."""
JUNK = ("__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini")  # files and folders that file managers add
WORD = re.compile(r"\d+|[^\W\d_]+")


def is_junk(name: str) -> bool:
    """Returns whether a file or folder with this name is hidden or was added by a file manager."""
    return name.casefold() in {junk.casefold() for junk in JUNK} or name.startswith(".")


def entry(folder: Path, name: str) -> Path:
    """Returns the path of the file or folder ``name`` in a folder, ignoring case, because operating systems change it.

    Without such a file, returns the path with this name. Raises InputError if two names differ only in case."""
    found = [path for path in sorted(folder.iterdir()) if path.name.casefold() == name] if folder.is_dir() else []
    if len(found) > 1:
        raise InputError(folder.name, [compose("names-of-other-case", names=[path.name for path in found])])
    return found[0] if found else folder / name


def has_raw_beside(path: Path) -> bool:
    """Returns whether the RAW file of a picture lies in the same folder, so that the RAW file is read instead."""
    if path.suffix.lower() not in IMAGE_SUFFIXES or path.suffix.lower() in RAW_SUFFIXES:
        return False
    return any(path.with_suffix(cased).is_file() for end in RAW_SUFFIXES for cased in (end, end.upper()))


def safe_name(name: str) -> str:
    """Converts a camera's name to letters, digits and ``-_.``, for file names and URLs. Blanks and signs become ``_``,
    accents are dropped, and other letters become their code points. Hidden names, and names that lead into other
    folders, are not changed."""
    if name.startswith(".") or any(c in "/\\" or unicodedata.category(c) in ("Cc", "Cf", "Cs") for c in name):
        return name
    plain = unicodedata.normalize("NFKD", name.strip())
    signs = [c if c.isascii() else f"u{ord(c):x}" for c in plain if not unicodedata.combining(c)]
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", "".join(signs)).strip("_.") or name


def picture_stem(name: str) -> str:
    """Removes a picture's suffix from a file name. Text after a dot that is no picture's suffix is kept."""
    stem, dot, ending = name.rpartition(".")
    return stem if dot and stem and f".{ending.lower()}" in (*IMAGE_SUFFIXES, *UNREAD_PICTURES) else name


def match_names(names: Iterable[str], cameras: Sequence[str], *, several: bool = False) -> dict[str, list[str]]:
    """Matches files to cameras by similar names, for cameras without a file of exactly their name. Returns the files by
    camera, without ambiguous files. ``names`` holds names of files (with suffixes) or folders. ``several`` allows a
    camera to have several files."""
    files = sorted(set(names))
    exact = {picture_stem(name) for name in files} | {name for name in files if name in cameras}
    lacking = {camera for camera in cameras if camera not in exact}
    strays = {name: _words(name) for name in files if name not in cameras and picture_stem(name) not in cameras}
    if not lacking or not strays:
        return {}
    words = {camera: _words(camera) for camera in cameras}
    matched: dict[str, list[str]] = {}
    for rule in (_equal, _alike_about, _naming_one, _numbered):
        found = rule(strays, words)
        for camera, pictures in found.items():
            if camera in lacking and camera not in matched and (several or len(pictures) == 1):
                matched[camera] = sorted(pictures)
        taken = {name for pictures in matched.values() for name in pictures}
        strays = {name: said for name, said in strays.items() if name not in taken}
    return matched


Words = tuple[str, ...]
Found = Mapping[str, Sequence[str]]


def _words(name: str) -> Words:
    while (stem := picture_stem(name)) != name:
        name = stem
    folded = safe_name(name).casefold()
    return tuple(word.lstrip("0") or "0" if word.isdecimal() else word for word in WORD.findall(folded))


def _equal(strays: Mapping[str, Words], cameras: Mapping[str, Words]) -> Found:
    """Matches files whose words equal a camera's words, for example "CAM_0.png" to cam00."""
    times = Counter(cameras.values())
    owners = {words: camera for camera, words in cameras.items() if words and times[words] == 1}
    return _by_owner((owners[words], name) for name, words in strays.items() if words in owners)


def _alike_about(strays: Mapping[str, Words], cameras: Mapping[str, Words]) -> Found:
    """Matches files whose names have the same words before and after each camera's words. Uses the surrounding words
    that fit most cameras."""
    fitting: dict[tuple[Words, Words], dict[str, list[str]]] = {}
    for name, words in strays.items():
        for camera, known in cameras.items():
            for start in _places(known, words):
                about = words[:start], words[start + len(known) :]
                fitting.setdefault(about, {}).setdefault(camera, []).append(name)
    if not fitting:
        return {}
    most = max(len(found) for found in fitting.values())
    best = [found for found in fitting.values() if len(found) == most]
    owners = Counter((camera, name) for found in best for camera, known in found.items() for name in known)
    claimed = Counter(name for _, name in owners)
    if most == 1 and any(not _is_telling(cameras[camera]) for camera, _ in owners):
        return {}  # a number in a single file's name proves nothing
    return _by_owner((camera, name) for camera, name in owners if claimed[name] == 1)


def _naming_one(strays: Mapping[str, Words], cameras: Mapping[str, Words]) -> Found:
    """Matches files whose words contain the words of a single camera, besides others such as times or counters."""
    pairs = []
    for name, words in strays.items():
        said = [camera for camera, known in cameras.items() if _is_telling(known) and _places(known, words)]
        longest = [camera for camera in said if not any(_within(cameras[camera], cameras[other]) for other in said)]
        pairs += [(longest[0], name)] if len(longest) == 1 else []
    return _by_owner(pairs)


def _numbered(strays: Mapping[str, Words], cameras: Mapping[str, Words]) -> Found:
    """Matches files that have only the words that distinguish cameras ("00.png" to cam00), if each camera has one."""
    ways = list(cameras.values())
    head = next((i for i, said in enumerate(zip(*ways, strict=False)) if len(set(said)) > 1), None)
    if head is None or len(cameras) < 2:
        return {}
    owners = {words[head:]: camera for camera, words in cameras.items()}
    found = _by_owner((owners[words], name) for name, words in strays.items() if words in owners)
    return found if len(owners) == len(cameras) == len(found) else {}


def _places(known: Words, words: Words) -> list[int]:
    """Returns the indices at which the words of a camera begin among the words of a file."""
    return [i for i in range(len(words) - len(known) + 1) if known and words[i : i + len(known)] == known]


def _within(known: Words, other: Words) -> bool:
    return known != other and bool(_places(known, other))


def _is_telling(words: Words) -> bool:
    """Returns whether any word is not a number, because numbers alone may be counters or dates."""
    return any(not word.isdecimal() for word in words)


def _by_owner(pairs: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for camera, name in pairs:
        found.setdefault(camera, []).append(name)
    return found
