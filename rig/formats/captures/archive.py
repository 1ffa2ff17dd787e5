"""Extracts an uploaded .zip, .tar or .tar.gz archive safely.

An uploaded archive may be malicious, so the module does not trust the sizes and names that it states. An archive
member's name and kind are checked before the member is written, and bytes are counted while unpacking. If the archive
is refused, the destination folder stays empty. Every fault of an archive names one of its members.

A member's name is decoded as UTF-8 if its bytes are valid UTF-8, because macOS writes UTF-8 without setting the zip
flag for it. Member names that are not UTF-8 are decoded as code page 437, the default of the zip format. Folders that
enclose the capture, and files that file managers add, are not written, so their names are checked less strictly.

Known attacks are described at https://www.bamsoftware.com/hacks/zipbomb (overlapping members), CVE-2007-4559 (traversal
and links in tar), https://www.unicode.org/reports/tr39 (confusable names)."""

import errno
import gzip
import os
import re
import stat
import struct
import tarfile
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BufferedIOBase
from itertools import pairwise, takewhile
from pathlib import Path, PurePosixPath

from rig.errors import InputError
from rig.formats.pictures.picture_names import JUNK
from rig.messages.message import Message, compose

COPY_BYTES = 1 << 20
SYNCS_AT_ONCE = 8  # writes them to the disk together: 5,000 small files take 1 s, one by one 22 s
UTF8_FLAG, DOS = 0x800, 0  # zip's flag for names in UTF-8, and its number of the system MS-DOS
FAULTS_MOST = 100  # faults listed singly; the others are only counted
SAME_LEAST = 3  # from so many members with the same fault on, one message stands for all
FOREIGN_KINDS = {
    b"7z\xbc\xaf\x27\x1c": "7-Zip",
    b"Rar!\x1a\x07": "RAR",
    b"BZh": "bzip2",
    b"\xfd7zXZ\x00": "xz",
    b"\x28\xb5\x2f\xfd": "Zstandard",
    b"\x1f\x9d": "compress",
}
DAMAGES = zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, struct.error, ValueError, RecursionError
HEADER_BYTES_MOST = 1 << 16  # of a tar header with a long name or pax records
DIRECTORY_BYTES_MOST = 4 << 20  # of a zip's list of members: 5000 with long names fit
UNICODE_PATH = 0x7075  # number of Info-ZIP's extra field that holds a name in UTF-8
COMPONENT_BYTES_MOST = 255  # of a file's or folder's name, on every usual file system
DROPPED = frozenset(name.casefold() for name in JUNK)  # never written
SCRIPTS = ("LATIN", "CYRILLIC", "GREEK", "ARMENIAN", "CHEROKEE", "COPTIC")  # alphabets whose letters look alike
WINDOWS_NAMES = re.compile(r"(?i)^(con|prn|aux|nul|com[0-9]|lpt[0-9])(\.|$)")


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    """Limits the content of one archive. 64 cameras with 32 pictures of the empty studio each have about 2,200
    files."""

    members: int = 5000
    total_bytes: int = 16 << 30
    member_bytes: int = 1 << 30
    ratio: float = 100.0  # unpacked / packed; PNG and JPEG do not shrink at all, uncompressed TIFF plates by about 20
    ratio_floor_bytes: int = 32 << 20  # the ratio is not checked below so many unpacked bytes
    depth: int = 8
    name_length: int = 150  # bytes of one part of a path; the whole path must stay below 4096


@dataclass(frozen=True, slots=True)
class _Member:
    """Holds one member of an archive. ``guessed`` is True if the archive does not state its name's encoding."""

    name: str
    size: int
    kind: str  # "file", "folder", or a word for what is not unpacked
    open: Callable[[], BufferedIOBase] | None = None
    guessed: bool = False

    @property
    def shown(self) -> str:
        """Returns the name for messages, or a replacement for a name that may be garbled."""
        text = re.sub(r"[^\x00-\x7f]", "?", self.name) if self.guessed else self.name
        return f"{text!r:.120}"


@dataclass(slots=True)
class _Faults:
    """Collects faults of members, and merges messages that differ only in the parameter ``member``."""

    by_cause: dict[tuple[object, ...], list[Message]] = field(default_factory=dict)

    def add(self, fault: Message) -> None:
        others = {name: value for name, value in fault.parameters.items() if name != "member"}
        self.by_cause.setdefault((fault.code, *others.items()), []).append(fault)

    def summarise(self) -> list[Message]:
        messages: list[Message] = []
        for faults in self.by_cause.values():
            if len(faults) < SAME_LEAST:
                messages += faults
            else:
                messages.append(compose("same-of-members", fault=faults[0], count=len(faults) - 1))
        return _first(messages)


def is_archive(path: Path) -> bool:
    """Returns whether the content of ``path`` begins like a .zip, .tar or .tar.gz archive."""
    return _format(path) is not None


def extract_archive(path: Path, folder: Path, limits: ArchiveLimits = ArchiveLimits()) -> tuple[str, ...]:
    """Unpacks ``path`` into the empty or absent ``folder`` and returns the relative names of the files written.

    Raises InputError naming every fault, and OSError for a full disk. After a failed unpacking, ``folder`` is empty."""
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(folder.name, [compose("archive-folder-not-empty")])
    try:
        with _opened(path) as members:
            return _extract(members, folder, limits, packed_bytes=path.stat().st_size)
    except BaseException:
        _empty(folder)
        raise


def pack_folder(folder: Path, path: Path) -> None:
    """Writes the files below ``folder`` to an uncompressed .tar, because image files do not compress further."""
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
    return "tar" if head[257:262] == b"ustar" or _is_old_header(head) else None


def _is_old_header(head: bytes) -> bool:
    """Returns whether ``head`` is the first header of a tar from before POSIX, recognised by its checksum."""
    if len(head) < tarfile.BLOCKSIZE or not head[0]:
        return False
    try:
        return tarfile.nti(head[148:156]) in tarfile.calc_chksums(head)  # type: ignore[attr-defined]
    except tarfile.HeaderError:
        return False


def _foreign_kind(path: Path) -> str | None:
    with path.open("rb") as stream:
        head = stream.read(8)
    return next((kind for sign, kind in FOREIGN_KINDS.items() if head.startswith(sign)), None)


@contextmanager
def _opened(path: Path) -> Iterator[Iterable[_Member]]:
    """Yields the members of an archive. Converts every exception due to a damaged archive to InputError."""
    kind = _format(path)
    if kind is None:
        foreign = _foreign_kind(path)
        fault = compose("archive-foreign", packer=foreign) if foreign else compose("archive-unknown")
        raise InputError("archive", [fault])
    try:
        if kind == "zip":
            _check_directory_size(path)
            with zipfile.ZipFile(path) as archive:
                yield _zip_members(archive)
        else:
            # tarfile's own gzip reader stops after the first of several gzip members, as pigz and bgzip write them.
            with (
                gzip.open(path) if kind == "tar.gz" else path.open("rb") as stream,
                tarfile.open(
                    fileobj=stream, mode="r|", tarinfo=_TarInfo, encoding="utf-8", errors="surrogateescape"
                ) as archive,
            ):
                yield _tar_members(archive)
    except InputError:
        raise
    except DAMAGES as error:
        raise InputError("archive", [compose("archive-damaged", reason=_words(error))]) from error
    except (NotImplementedError, RuntimeError) as error:  # zipfile's errors for unknown methods and encrypted members
        raise InputError("archive", [compose("archive-not-unpacked", reason=_words(error))]) from error
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EACCES, errno.EROFS, errno.EMFILE):
            raise
        raise InputError("archive", [compose("archive-damaged", reason=_words(error))]) from error


class _TarInfo(tarfile.TarInfo):
    """Limits the size of extra headers, such as long names, because tarfile reads a whole extra header into memory."""

    def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        if self.type not in (*tarfile.SUPPORTED_TYPES, tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE):
            raise InputError(
                "archive", [compose("member-of-kind", member=f"{self.name!r:.120}", kind=f"{self.type!r}")]
            )
        if not self.isreg() and self.size > HEADER_BYTES_MOST:
            raise InputError("archive", [compose("member-header-large", member=f"{self.name!r:.120}", bytes=self.size)])
        return super()._proc_member(archive)  # type: ignore[misc]


def _check_directory_size(path: Path) -> None:
    """Raises InputError if the zip's list of members is too long, because zipfile reads the whole list into memory."""
    with path.open("rb") as stream:
        end = zipfile._EndRecData(stream)  # type: ignore[attr-defined]
    if end is not None and end[5] > DIRECTORY_BYTES_MOST:
        raise InputError("archive", [compose("archive-list-long", bytes=end[5])])


def _zip_members(archive: zipfile.ZipFile) -> list[_Member]:
    infos = archive.infolist()
    windows = not any("/" in info.orig_filename for info in infos)
    members = [_zip_member(archive, info, windows=windows) for info in infos]
    starts = sorted(
        (info.header_offset, info.compress_size, member.shown) for info, member in zip(infos, members, strict=True)
    )
    faults = _Faults()
    for (offset, size, shown), following in pairwise(starts):
        if offset + 30 + size > following[0]:
            faults.add(compose("member-overlaps", member=shown))
    for info, member in zip(infos, members, strict=True):
        if info.flag_bits & 0x1:
            faults.add(compose("member-encrypted", member=member.shown))
        elif info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
            faults.add(compose("member-method", member=member.shown, method=info.compress_type))
    if faults.by_cause:
        raise InputError("archive", faults.summarise())
    return members


def _zip_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, *, windows: bool) -> _Member:
    """Returns a member of a zip. ``windows`` is True if no name in the archive has a slash, so that backslashes
    separate folders."""
    name, guessed = info.orig_filename, False
    if not info.flag_bits & UTF8_FLAG:
        raw = name.encode("cp437")  # as zipfile decoded it
        name, guessed = decoded_name(unicode_path(info.extra, raw) or raw)
    kind = _zip_kind(info)
    if windows and info.create_system == DOS and "\\" in name:
        name = name.replace("\\", "/")
        kind = "folder" if kind == "file" and name.endswith("/") and not info.file_size else kind
    return _Member(name, info.file_size, kind, lambda: _buffered(archive.open(info)), guessed)


_NO_FILES = {
    "symbolic link": compose("symbolic-link"),
    "hard link": compose("hard-link"),
    "sparse file": compose("sparse-file"),
    "device or pipe": compose("device-or-pipe"),
}


def _zip_kind(info: zipfile.ZipInfo) -> str:
    mode = info.external_attr >> 16
    if stat.S_ISLNK(mode):
        return "symbolic link"
    if mode and stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "device or pipe"
    return "folder" if info.is_dir() or stat.S_ISDIR(mode) else "file"


def _tar_members(archive: tarfile.TarFile) -> Iterator[_Member]:
    for info in archive:
        if info.issym():
            kind = "symbolic link"
        elif info.islnk():
            kind = "hard link"
        elif info.isdir():
            kind = "folder"
        elif info.isreg() and not info.issparse():
            kind = "file"
        else:
            kind = "sparse file" if info.issparse() else "device or pipe"
        name, guessed = decoded_name(info.name.encode("utf-8", "surrogateescape"))
        yield _Member(name, info.size, kind, lambda info=info: _buffered(archive.extractfile(info)), guessed)


def _buffered(stream: object) -> BufferedIOBase:
    assert isinstance(stream, BufferedIOBase)  # only regular files are opened
    return stream


def _extract(members: Iterable[_Member], folder: Path, limits: ArchiveLimits, packed_bytes: int) -> tuple[str, ...]:
    """Writes an archive's files until the first fault, and only checks later members. Faults in names of folders that
    enclose all files are ignored at the end, because such folders are not written."""
    faults = _Faults()
    seen: dict[str, tuple[str, str]] = {}
    odd: dict[tuple[str, ...], list[Message]] = {}
    written: list[str] = []
    room = min(limits.total_bytes, max(limits.ratio_floor_bytes, int(limits.ratio * packed_bytes)))
    for number, member in enumerate(members, 1):
        room -= max(0, member.size)  # skipped members count too: a tar's member is unpacked to skip it
        if number > limits.members or room < 0 or member.size > limits.member_bytes:
            faults.add(_too_much(number, member, limits, packed_bytes))
            break
        name = _judge(member, seen, odd, faults, limits)
        if name is not None and not faults.by_cause:
            if fault := _write(member, folder / name):
                faults.add(fault)
            written.append(name)
    around = _common_folder(written)
    for parts, messages in odd.items():
        if parts != around[: len(parts)]:
            for fault in messages:
                faults.add(fault)
    if not written and not faults.by_cause:
        faults.add(compose("archive-empty"))
    if faults.by_cause:
        raise InputError("archive", faults.summarise())
    with ThreadPoolExecutor(SYNCS_AT_ONCE) as pool:
        list(pool.map(_sync, (folder / name for name in written)))
    return tuple(written)


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _common_folder(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the parts of the path of the innermost folder that contains all files."""
    folders = [tuple(name.split("/")[:-1]) for name in names] or [()]
    return tuple(same[0] for same in takewhile(lambda parts: len(set(parts)) == 1, zip(*folders, strict=False)))


def _write(member: _Member, path: Path) -> Message | None:
    assert member.open is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    size = 0
    with member.open() as source, path.open("xb") as target:
        while size <= member.size and (block := source.read(COPY_BYTES)):
            size += len(block)
            target.write(block)
    if size != member.size:
        return compose("member-size-wrong", member=member.shown, bytes=member.size)
    return None


def _too_much(number: int, member: _Member, limits: ArchiveLimits, packed_bytes: int) -> Message:
    if number > limits.members:
        return compose("archive-members-many", most=limits.members)
    if member.size > limits.member_bytes:
        return compose("member-large", member=member.shown, bytes=member.size, most=limits.member_bytes)
    return compose("archive-large", bytes=limits.total_bytes, ratio=limits.ratio, packed_bytes=packed_bytes)


def _judge(
    member: _Member,
    seen: dict[str, tuple[str, str]],
    odd: dict[tuple[str, ...], list[Message]],
    faults: _Faults,
    limits: ArchiveLimits,
) -> str | None:
    """Returns the relative name to which a member is written, or None to skip it. Adds the archive member's faults to
    ``faults``. ``odd`` collects faults of folder names by path, which are ignored if the folder is not written."""
    if member.kind not in ("file", "folder"):
        faults.add(compose("member-no-file", member=member.shown, kind=_NO_FILES[member.kind]))
        return None
    if wrong := path_faults(member.name, member.shown, depth=limits.depth, name_length=limits.name_length):
        for fault in wrong:
            faults.add(fault)
        return None
    parts = [part for part in PurePosixPath(member.name).parts if part != "."]
    dropped = any(part.startswith("._") or part.casefold() in DROPPED for part in parts)  # file managers add them
    if member.kind == "folder" or not parts or dropped:
        return None
    for depth, part in enumerate(parts, 1):
        here = tuple(parts[:depth])
        for fault in name_faults(part, member.shown, name_length=limits.name_length) if here not in odd else ():
            garbled = compose("member-name-encoding", member=member.shown)
            odd.setdefault(here, []).append(garbled if member.guessed else fault)
    for depth in range(1, len(parts) + 1):
        fault = name_clash(parts[:depth], member.shown, "file" if depth == len(parts) else "folder", seen)
        if fault:
            faults.add(fault)
            return None
    return "/".join(parts)


def _first(faults: list[Message]) -> list[Message]:
    more = len(faults) - FAULTS_MOST
    return faults[:FAULTS_MOST] + ([compose("faults-more", more=more)] if more > 0 else [])


def _words(error: Exception) -> str:
    return str(error)[:200] or type(error).__name__


def _empty(folder: Path) -> None:
    """Removes all files and folders in ``folder``."""
    for path in sorted(folder.rglob("*"), key=lambda p: len(p.parts), reverse=True):
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()


def decoded_name(raw: bytes) -> tuple[str, bool]:
    """Decodes a member's name. Returns the archive member's name, and whether its encoding is a guess."""
    try:
        return raw.decode("utf-8"), False
    except UnicodeDecodeError:
        return raw.decode("cp437"), True


def unicode_path(extra: bytes, raw: bytes) -> bytes | None:
    """Returns the UTF-8 name from Info-ZIP's extra field of a member. Returns None if the field is missing or its
    checksum does not match the name ``raw``."""
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


def name_clash(parts: list[str], shown: str, kind: str, seen: dict[str, tuple[str, str]]) -> Message | None:
    """Returns a fault if a name equals another member's name, or if some file systems do not distinguish the two names.
    Adds the member's name to ``seen``."""
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
    """Returns faults of a member's path that not even skipped members may have. Messages name the member ``shown``."""
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
    """Returns faults of one part of the path of a file or folder that is written."""
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
