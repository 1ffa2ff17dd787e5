"""Safe extraction of an uploaded .zip, .tar or .tar.gz.

An archive comes from a stranger. Nothing in it is believed: members are listed and judged by name and kind before the
first byte is written, bytes are counted as they come out, and a refusal leaves the folder as it was. Every fault is
named with the member that has it. Sources of the attacks: https://www.bamsoftware.com/hacks/zipbomb (overlapping
members), CVE-2007-4559 (traversal and links in tar), https://www.unicode.org/reports/tr39 (confusable names).
"""

import errno
import os
import re
import stat
import struct
import tarfile
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedIOBase
from itertools import pairwise
from pathlib import Path, PurePosixPath

from rig.errors import InputError

COPY_BYTES = 1 << 20
FAULTS_MOST = 100  # named one by one; the rest are counted
HEADER_BYTES_MOST = 1 << 16  # a tar header's long name or pax records
DIRECTORY_BYTES_MOST = 4 << 20  # a zip's list of members: 5000 of them with long names
JUNK = ("__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini")  # what file managers add; never written
SCRIPTS = ("LATIN", "CYRILLIC", "GREEK", "ARMENIAN", "CHEROKEE", "COPTIC")  # alphabets whose letters look alike
WINDOWS_NAMES = re.compile(r"(?i)^(con|prn|aux|nul|com[0-9]|lpt[0-9])(\.|$)")


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    """What one archive may hold. 64 cameras with 32 clean plates each are about 2,200 files."""

    members: int = 5000
    total_bytes: int = 16 << 30
    member_bytes: int = 1 << 30
    ratio: float = 100.0  # unpacked / packed; PNG and JPEG do not shrink at all, uncompressed TIFF plates by about 20
    ratio_floor_bytes: int = 32 << 20  # below this no ratio is a danger
    depth: int = 8
    name_length: int = 150  # a component; with the folder's own path it must stay below 4096


@dataclass(frozen=True, slots=True)
class _Member:
    name: str
    size: int
    kind: str  # "file", "folder", or what is wrong with it
    open: Callable[[], BufferedIOBase] | None = None


def is_archive(path: Path) -> bool:
    """Whether the content (not the name) of ``path`` begins like a .zip, .tar or .tar.gz."""
    return _format(path) is not None


def extract_archive(path: Path, folder: Path, limits: ArchiveLimits = ArchiveLimits()) -> tuple[str, ...]:
    """Unpacks ``path`` into the empty or absent ``folder`` and returns the relative names of the files written.

    Raises InputError naming every fault; then nothing is left in ``folder``. OSError (a full disk) passes through, with
    nothing left either.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(folder.name, ["is not empty; an archive is unpacked into a folder of its own"])
    try:
        with _opened(path) as members:
            return _extract(members, folder, limits, packed_bytes=path.stat().st_size)
    except BaseException:
        _empty(folder)
        raise


def pack_folder(folder: Path, path: Path) -> None:
    """Writes the files below ``folder`` into an uncompressed .tar: images do not shrink any more."""
    with tarfile.open(path, "w") as archive:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            archive.add(file, arcname=file.relative_to(folder).as_posix(), recursive=False)


def _format(path: Path) -> str | None:
    with path.open("rb") as stream:
        head = stream.read(512)
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return "zip"
    if head.startswith(b"\x1f\x8b"):
        return "tar.gz"
    return "tar" if head[257:262] == b"ustar" else None


@contextmanager
def _opened(path: Path) -> Iterator[Iterable[_Member]]:
    """The members of an archive; every way a damaged one can fail becomes an InputError."""
    kind = _format(path)
    if kind is None:
        raise InputError("archive", ["is damaged or no .zip, .tar or .tar.gz (told by its first bytes)"])
    try:
        if kind == "zip":
            _check_directory_size(path)
            with zipfile.ZipFile(path) as archive:
                yield _zip_members(archive)
        else:
            with tarfile.open(path, "r|gz" if kind == "tar.gz" else "r|", tarinfo=_TarInfo) as archive:
                yield _tar_members(archive)
    except InputError:
        raise
    except (
        zipfile.BadZipFile,
        tarfile.TarError,
        zlib.error,
        EOFError,
        struct.error,
        ValueError,
        RecursionError,
    ) as error:
        raise InputError("archive", [f"is damaged or cut off ({_words(error)})"]) from error
    except (NotImplementedError, RuntimeError) as error:  # what zipfile raises for methods and keys it does not have
        raise InputError("archive", [f"cannot be unpacked ({_words(error)}); pack it with plain deflate"]) from error
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EACCES, errno.EROFS, errno.EMFILE):
            raise
        raise InputError("archive", [f"is damaged or cut off ({_words(error)})"]) from error


class _TarInfo(tarfile.TarInfo):
    """tarfile reads the extra header of a long name into memory whole, whatever size it claims."""

    def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        if self.type not in (*tarfile.SUPPORTED_TYPES, tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE):
            raise InputError("archive", [f"{self.name!r:.120} is of a kind ({self.type!r}) that is not unpacked"])
        if not self.isreg() and self.size > HEADER_BYTES_MOST:
            raise InputError("archive", [f"{self.name!r:.120} has a header of {self.size:,} bytes"])
        return super()._proc_member(archive)  # type: ignore[misc]


def _check_directory_size(path: Path) -> None:
    """zipfile reads the list of members into memory whole; its length stands in the end record."""
    with path.open("rb") as stream:
        end = zipfile._EndRecData(stream)  # type: ignore[attr-defined]
    if end is not None and end[5] > DIRECTORY_BYTES_MOST:
        raise InputError("archive", [f"has a list of members {end[5]:,} bytes long: too many members"])


def _zip_members(archive: zipfile.ZipFile) -> list[_Member]:
    infos = archive.infolist()
    starts = sorted((info.header_offset, info.compress_size, info.filename) for info in infos)
    faults = [
        f"{name!r:.120} overlaps the next member: a zip bomb"
        for (offset, size, name), following in pairwise(starts)
        if offset + 30 + size > following[0]
    ]
    for info in infos:
        if info.flag_bits & 0x1:
            faults.append(f"{info.filename!r:.120} is encrypted")
        elif info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
            faults.append(f"{info.filename!r:.120} is packed with method {info.compress_type}, which is not supported")
    if faults:
        raise InputError("archive", _first(faults))
    return [
        _Member(info.orig_filename, info.file_size, _zip_kind(info), lambda info=info: _buffered(archive.open(info)))
        for info in infos
    ]


def _zip_kind(info: zipfile.ZipInfo) -> str:
    mode = info.external_attr >> 16
    if stat.S_ISLNK(mode):
        return "is a symbolic link"
    if mode and stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a device or pipe"
    return "folder" if info.is_dir() or stat.S_ISDIR(mode) else "file"


def _tar_members(archive: tarfile.TarFile) -> Iterator[_Member]:
    for info in archive:
        if info.issym():
            kind = "is a symbolic link"
        elif info.islnk():
            kind = "is a hard link"
        elif info.isdir():
            kind = "folder"
        elif info.isreg() and not info.issparse():
            kind = "file"
        else:
            kind = "is a sparse file" if info.issparse() else "is a device or pipe"
        yield _Member(info.name, info.size, kind, lambda info=info: _buffered(archive.extractfile(info)))


def _buffered(stream: object) -> BufferedIOBase:
    assert isinstance(stream, BufferedIOBase)  # only regular files are opened
    return stream


def _extract(members: Iterable[_Member], folder: Path, limits: ArchiveLimits, packed_bytes: int) -> tuple[str, ...]:
    """Writes the files while no fault is known; after the first fault only the rest of the list is judged."""
    faults: list[str] = []
    seen: dict[str, tuple[str, str]] = {}
    written: list[str] = []
    room = min(limits.total_bytes, max(limits.ratio_floor_bytes, int(limits.ratio * packed_bytes)))
    for number, member in enumerate(members, 1):
        room -= max(0, member.size)  # to pass over a tar's member means to unpack it
        if number > limits.members or room < 0 or member.size > limits.member_bytes:
            faults.append(_too_much(number, member, limits, packed_bytes))
            break
        name, problems = _judge(member, seen, limits)
        faults += problems
        if name is not None and not faults:
            faults += _write(member, folder / name)
            written.append(name)
    if not written and not faults:
        faults.append("holds no files")
    if faults:
        raise InputError("archive", _first(faults))
    return tuple(written)


def _write(member: _Member, path: Path) -> list[str]:
    assert member.open is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    size = 0
    with member.open() as source, path.open("xb") as target:
        while size <= member.size and (block := source.read(COPY_BYTES)):
            size += len(block)
            target.write(block)
        target.flush()
        os.fsync(target.fileno())
    if size != member.size:
        return [f"{member.name!r:.120} does not hold the {member.size:,} bytes that its header says"]
    return []


def _too_much(number: int, member: _Member, limits: ArchiveLimits, packed_bytes: int) -> str:
    if number > limits.members:
        return f"holds more than {limits.members} members"
    if member.size > limits.member_bytes:
        return f"{member.name!r:.120} is {member.size:,} bytes; at most {limits.member_bytes:,} are read"
    return (
        f"unpacks to more than is allowed: {limits.total_bytes:,} bytes, or {limits.ratio:g} times its own "
        f"{packed_bytes:,} bytes"
    )


def _judge(member: _Member, seen: dict[str, tuple[str, str]], limits: ArchiveLimits) -> tuple[str | None, list[str]]:
    """The relative name to write to (None: nothing to write) and what is wrong with the member."""
    shown = f"{member.name!r:.120}"
    if member.kind not in ("file", "folder"):
        return None, [f"{shown} {member.kind}; only files and folders are unpacked"]
    faults = [f"{shown} {fault}" for fault in _name_faults(member.name, limits)]
    if faults:
        return None, faults
    parts = [part for part in PurePosixPath(member.name).parts if part != "."]
    if member.kind == "folder" or not parts or any(part in JUNK or part.startswith("._") for part in parts):
        return None, []
    name = "/".join(parts)
    for depth in range(1, len(parts) + 1):
        fault = _clash(parts[:depth], "file" if depth == len(parts) else "folder", shown, seen)
        if fault:
            return None, [fault]
    return name, []


def _clash(parts: list[str], kind: str, shown: str, seen: dict[str, tuple[str, str]]) -> str | None:
    """A name that another member has already, or that some file system or reader takes for another's."""
    name = "/".join(parts)
    key = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    other = seen.get(key)
    if other is None:
        seen[key] = (name, kind)
        return None
    if other == (name, "folder") and kind == "folder":
        return None
    return (
        f"{shown} occurs twice"
        if other[0] == name
        else f"{shown} is the same name as {other[0]!r:.120} in other letters"
    )


def _name_faults(name: str, limits: ArchiveLimits) -> list[str]:
    if "\0" in name or any(unicodedata.category(c) in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp") for c in name):
        return ["has an invisible or control character in its name"]
    if "\\" in name or re.match(r"^[A-Za-z]:", name):
        return ["has a backslash or a drive letter in its name"]
    if name.startswith("/"):
        return ["is an absolute path"]
    parts = name.rstrip("/").split("/")
    if ".." in parts:
        return ["leads out of the archive ('..')"]
    faults = []
    if len(parts) > limits.depth:
        faults.append(f"lies {len(parts)} folders deep; at most {limits.depth} are unpacked")
    if any(len(part.encode()) > limits.name_length for part in parts):
        faults.append(f"has a name longer than {limits.name_length} bytes")
    if any(WINDOWS_NAMES.match(part) for part in parts):
        faults.append("has a name that Windows reserves for a device")
    if any(len(_scripts(part)) > 1 for part in parts):
        faults.append("mixes letters of several alphabets in its name")
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


def _first(faults: list[str]) -> list[str]:
    more = len(faults) - FAULTS_MOST
    return faults[:FAULTS_MOST] + ([f"and {more} more faults"] if more > 0 else [])


def _words(error: Exception) -> str:
    return str(error)[:200] or type(error).__name__


def _empty(folder: Path) -> None:
    """Removes what this module wrote below ``folder``, which was empty before."""
    for path in sorted(folder.rglob("*"), key=lambda p: len(p.parts), reverse=True):
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
