"""Decodes the names of an archive's members, and refuses names that must not be written.

A name is read as UTF-8 if its bytes are valid UTF-8, whatever the archive states, because macOS writes UTF-8 without
setting the flag for it; otherwise as code page 437, the zip format's own. Names that are not kept, those of folders
around the capture and of files that file managers add, need only be writable."""

import re
import struct
import unicodedata
import zlib

from rig.formats.pictures.picture_names import JUNK
from rig.messages.message import Message, compose

UNICODE_PATH = 0x7075  # number of Info-ZIP's extra field that holds a name in UTF-8
COMPONENT_BYTES_MOST = 255  # of a file's or folder's name, on every usual file system
DROPPED = frozenset(name.casefold() for name in JUNK)  # never written
SCRIPTS = ("LATIN", "CYRILLIC", "GREEK", "ARMENIAN", "CHEROKEE", "COPTIC")  # alphabets whose letters look alike
WINDOWS_NAMES = re.compile(r"(?i)^(con|prn|aux|nul|com[0-9]|lpt[0-9])(\.|$)")


def decoded_name(raw: bytes) -> tuple[str, bool]:
    """Returns a name, and whether its encoding is a guess."""
    try:
        return raw.decode("utf-8"), False
    except UnicodeDecodeError:
        return raw.decode("cp437"), True


def unicode_path(extra: bytes, raw: bytes) -> bytes | None:
    """Returns the name in UTF-8 from Info-ZIP's extra field, or None. The field counts only if its checksum is that of
    the name ``raw``."""
    at = 0
    while at + 4 <= len(extra):
        kind, size = struct.unpack_from("<HH", extra, at)
        data = extra[at + 4 : at + 4 + size]
        if (
            kind == UNICODE_PATH
            and len(data) > 5
            and data[0] == 1
            and data[1:5] == zlib.crc32(raw).to_bytes(4, "little")
        ):
            return data[5:]
        at += 4 + size
    return None


def is_dropped(part: str) -> bool:
    """Tells whether a file or folder of this name is never written: file managers add it."""
    return part.startswith("._") or part.casefold() in DROPPED


def name_clash(parts: list[str], shown: str, kind: str, seen: dict[str, tuple[str, str]]) -> Message | None:
    """Returns a fault if a name repeats another member's, or if some file system or reader would take both for the
    same. Adds the name to ``seen``."""
    name = "/".join(parts)
    key = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    other = seen.get(key)
    if other is None:
        seen[key] = (name, kind)
        return None
    if other == (name, "folder") and kind == "folder":
        return None
    if other[0] == name:
        return compose("member-twice", member=shown)
    return compose("member-name-alike", member=shown, other=f"{other[0]!r:.120}")


def path_faults(name: str, shown: str, *, depth: int, name_length: int) -> list[Message]:
    """Returns faults of a member's path that no member may have, kept or not. Messages call the member ``shown``."""
    if any(unicodedata.category(c) in ("Cc", "Cs") for c in name):
        return [compose("member-name-invisible", member=shown)]
    if "\\" in name or re.match(r"^[A-Za-z]:", name):
        return [compose("member-name-backslash", member=shown)]
    if name.startswith("/"):
        return [compose("member-absolute", member=shown)]
    parts = name.rstrip("/").split("/")
    if ".." in parts:
        return [compose("member-leads-out", member=shown)]
    faults = []
    if len(parts) > depth:
        faults.append(compose("member-deep", member=shown, depth=len(parts), most=depth))
    if any(len(part.encode()) > COMPONENT_BYTES_MOST for part in parts):
        faults.append(compose("member-name-long", member=shown, most=name_length))
    return faults


def name_faults(part: str, shown: str, *, name_length: int) -> list[Message]:
    """Returns faults of one part of a path that a kept file or folder must not have."""
    faults = []
    if any(unicodedata.category(c) in ("Cf", "Co", "Cn", "Zl", "Zp") for c in part):
        faults.append(compose("member-name-invisible", member=shown))
    if len(part.encode()) > name_length:
        faults.append(compose("member-name-long", member=shown, most=name_length))
    if WINDOWS_NAMES.match(part):
        faults.append(compose("member-name-reserved", member=shown))
    if any(len(_scripts(word)) > 1 for word in re.findall(r"[^\W\d_]+", part)):
        faults.append(compose("member-name-mixed", member=shown))
    return faults


def _scripts(text: str) -> set[str]:
    found = set()
    for character in text:
        if character.isascii():
            if character.isalpha():
                found.add("LATIN")
            continue
        words = unicodedata.name(character, "").split(" ", 1)
        if words[0] in SCRIPTS:
            found.add(words[0])
    return found
