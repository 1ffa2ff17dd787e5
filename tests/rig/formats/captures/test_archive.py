"""Hostile and honest archives: each refusal names its member, and leaves the folder as it was; names as programs of
many countries write them; what is said of each fault, and where each limit lies."""

import gzip
import io
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.errors import InputError
from rig.formats.captures import archive as rules
from rig.formats.captures.archive import ArchiveLimits, extract_archive, is_archive
from rig.messages.message import texts_of

FOLDERS = {
    "japanese": "頭スキャン01",
    "chinese": "扫描_张伟",
    "german, decomposed": "Anna Mu\u0308ller",
    "russian beside latin": "Скан_head",
    "russian and latin in a word": "\u0421kan",
    "greek": "Κεφάλι scan1",
    "persian with a joiner": "\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645",
    "emoji of an unknown kind": "scan \U0001fadf\U0001f468\u200d\U0001f52c",
    "a device of Windows": "aux.2024",
    "of 200 bytes": "頭" * 66,
}
MEMBERS = ("cameras.json", "images/cam00.png", "images/cam01.png")
LIMITS = ArchiveLimits()


def zip_of(*members: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in members:
            archive.writestr(name, data, compress_type=method)
    return buffer.getvalue()


def tar_of(*members: tuple[str | tarfile.TarInfo, bytes], mode: str = "w", form: int = tarfile.PAX_FORMAT) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode, format=form) as archive:  # type: ignore[call-overload]
        for entry, data in members:
            info = tarfile.TarInfo(entry) if isinstance(entry, str) else entry
            if info.isreg():
                info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


def tar_entry(name: str, kind: bytes, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def zip_entry(name: str, mode: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.create_system, info.external_attr = 3, mode << 16
    return info


def patched(data: bytes, at: bytes, offset: int, value: bytes) -> bytes:
    """``data`` with ``value`` written ``offset`` bytes after every ``at``."""
    out, start = bytearray(data), 0
    while (found := data.find(at, start)) >= 0:
        out[found + offset : found + offset + len(value)] = value
        start = found + 1
    return bytes(out)


def overlapping_zip() -> bytes:
    """Fifield's construction in small: two members of the central directory share one stream."""
    data = zip_of(("a.png", b"x" * 1000), ("b.png", b"x" * 1000))
    second = data.rfind(b"PK\x01\x02")
    return data[: second + 42] + struct.pack("<I", 0) + data[second + 46 :]


def lying_zip(size: int) -> bytes:
    data = zip_of(("images/cam00.png", b"x" * 5000))
    return patched(
        patched(data, b"PK\x03\x04", 22, struct.pack("<I", size)), b"PK\x01\x02", 24, struct.pack("<I", size)
    )


def long_header_tar() -> bytes:
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 1 << 33
    return gzip.compress(info.tobuf(tarfile.GNU_FORMAT) + b"a" * 4096)


def huge_tar_claim() -> bytes:
    info = tarfile.TarInfo("images/cam00.png")
    info.size = 1 << 40
    return gzip.compress(info.tobuf(tarfile.GNU_FORMAT) + bytes(1 << 16))


def encrypted_zip() -> bytes:
    data = zip_of(("cameras.json", b"{}"))
    return patched(patched(data, b"PK\x03\x04", 6, b"\x01\x00"), b"PK\x01\x02", 8, b"\x01\x00")


def wrong_crc_zip() -> bytes:
    data = zip_of(("images/cam00.png", b"some pixels"), method=zipfile.ZIP_STORED)
    return data.replace(b"some pixels", b"same pixels", 1)


KINDS = "; only files and folders are unpacked: replace it by a file, or leave it out"
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "no .zip"),
    "noise": (lambda: bytes(range(256)) * 40, "no .zip"),
    "html": (lambda: b"<html>not found</html>" * 40, "no .zip"),
    "empty zip": (lambda: zip_of(), "no files"),
    "empty tar": (lambda: tar_of(), "no .zip"),
    "zip traversal": (lambda: zip_of(("../../etc/passwd", b"x")), "leads out"),
    "tar traversal": (lambda: tar_of(("images/../../../x", b"x")), "leads out of the archive ('..')"),
    "zip absolute": (lambda: zip_of(("/etc/passwd", b"x")), "absolute"),
    "tar absolute": (lambda: tar_of(("/etc/passwd", b"x")), "'/etc/passwd' is an absolute path"),
    "backslash": (lambda: zip_of(("images\\..\\..\\x", b"x")), "backslash"),
    "drive": (lambda: zip_of(("C:/x", b"x")), "has a backslash or a drive letter in its name: rename it"),
    "device name": (lambda: zip_of(("images/CON.png", b"x")), "has a name that Windows reserves for a device"),
    "tar symlink": (lambda: tar_of((tar_entry("images", tarfile.SYMTYPE, "/etc"), b"")), f"symbolic link{KINDS}"),
    "tar symlink in use": (
        lambda: tar_of((tar_entry("images", tarfile.SYMTYPE, "/etc"), b""), ("images/passwd", b"x")),
        "symbolic link",
    ),
    "tar hard link": (lambda: tar_of((tar_entry("a.png", tarfile.LNKTYPE, "/x"), b"")), f"is a hard link{KINDS}"),
    "tar sparse": (lambda: tar_of((tar_entry("a.png", tarfile.GNUTYPE_SPARSE), b"")), f"is a sparse file{KINDS}"),
    "tar kind": (lambda: tar_of((tar_entry("a.png", b"Q"), b"")), "'a.png' has the type b'Q', which is not unpacked"),
    "tar character device": (lambda: tar_of((tar_entry("a.png", tarfile.CHRTYPE), b"")), f"a device or pipe{KINDS}"),
    "tar block device": (lambda: tar_of((tar_entry("a.png", tarfile.BLKTYPE), b"")), "device or pipe"),
    "tar pipe": (lambda: tar_of((tar_entry("a.png", tarfile.FIFOTYPE), b"")), "device or pipe"),
    "zip symlink": (lambda: zip_of((zip_entry("a.png", stat.S_IFLNK | 0o777), b"/etc/passwd")), "symbolic link"),
    "zip pipe": (lambda: zip_of((zip_entry("a.png", stat.S_IFIFO | 0o644), b"")), "device or pipe"),
    "zip twice": (lambda: zip_of_twice("a.png"), "occurs twice"),
    "tar twice": (lambda: tar_of(("a.png", b"1"), ("a.png", b"2")), "occurs twice"),
    "tar twice with a dot": (lambda: tar_of(("a.png", b"1"), ("./a.png", b"2")), "occurs twice"),
    "letter case": (lambda: tar_of(("A.png", b"1"), ("a.png", b"2")), "is the same name as 'A.png' in other letters"),
    "composed and decomposed": (lambda: tar_of(("\u00e9.png", b"1"), ("e\u0301.png", b"2")), "other letters"),
    "full width": (lambda: tar_of(("a.png", b"1"), ("\uff41.png", b"2")), "other letters"),
    "cyrillic a": (
        lambda: tar_of(("images/c\u0430m00.png", b"1")),
        "mixes letters of several alphabets in its name: rename it",
    ),
    "file and folder": (lambda: tar_of(("images", b"1"), ("images/a.png", b"2")), "occurs twice"),
    "long name": (lambda: tar_of(("a" * 300 + ".png", b"1")), "longer than"),
    "deep": (lambda: tar_of(("a/" * 40 + "a.png", b"1")), "folders deep"),
    "many members": (lambda: tar_of(*((f"{i}.png", b"") for i in range(60))), "more than 50 members"),
    "zip bomb": (lambda: zip_of(("a.png", bytes(40 << 20))), "unpacks to more"),
    "tar.gz bomb": (lambda: tar_of(("a.png", bytes(40 << 20)), mode="w:gz"), "unpacks to more"),
    "many small bombs": (lambda: zip_of(*((f"{i}.png", bytes(4 << 20)) for i in range(12))), "unpacks to more"),
    "overlapping zip": (overlapping_zip, "'a.png' overlaps the next member: a zip bomb"),
    "zip says less": (lambda: lying_zip(10), "damaged"),
    "zip says more": (lambda: lying_zip(9000), "does not hold"),
    "tar says a terabyte": (huge_tar_claim, "at most"),
    "tar long header": (long_header_tar, "has a header of"),
    "encrypted": (encrypted_zip, "is encrypted: pack the folder without a password"),
    "unknown method": (lambda: patched(zip_of(("a.png", b"x" * 99)), b"PK\x01\x02", 10, b"\x63\x00"), "method 99"),
    "wrong checksum": (wrong_crc_zip, "damaged"),
    "zip cut off": (lambda: zip_of(("a.png", bytes(range(256)) * 99))[:-40], "damaged"),
    "tar cut off": (lambda: tar_of(("a.png", bytes(range(256)) * 99))[:9000], "damaged"),
    "tar.gz cut off": (lambda: tar_of(("a.png", bytes(range(256)) * 99), mode="w:gz")[:-60], "damaged"),
    "gz of no tar": (lambda: gzip.compress(b"hello" * 1000), "damaged"),
    "tar checksum": (lambda: patched(tar_of(("a.png", b"1")), b"a.png", 0, b"b"), "damaged"),
}


def zip_of_twice(name: str) -> bytes:
    with pytest.warns(UserWarning, match="Duplicate name"):
        return zip_of((name, b"1"), (name, b"2"))


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_archive_is_refused_by_name_and_leaves_nothing(case: str, tmp_path: Path) -> None:
    make, word = HOSTILE[case]
    (tmp_path / "upload").write_bytes(make())
    with pytest.raises(InputError) as caught:
        extract_archive(tmp_path / "upload", tmp_path / "out", ArchiveLimits(members=50))
    assert word in str(caught.value)
    assert list((tmp_path / "out").iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "upload"]


@pytest.mark.parametrize("kind", ["zip", "stored zip", "tar", "tar.gz", "gzip of several members"])
def test_an_honest_archive_comes_out_whole(kind: str, tmp_path: Path) -> None:
    large = bytes(range(256)) * 10_000
    assert len(large) > 2 * rules.COPY_BYTES
    files = {"Müller/cameras.json": b"{}", "Müller/images/cam00.png": large, "Müller/images/leer.png": b""}
    junk = ("__MACOSX/Müller/._cam00.png", "Müller/.DS_Store", "Müller/images/Thumbs.db")
    members = [*files.items(), *((name, b"junk") for name in junk)]
    tar = tar_of(*members)
    data = {
        "zip": lambda: zip_of(*members),
        "stored zip": lambda: zip_of(*members, method=zipfile.ZIP_STORED),
        "tar": lambda: tar,
        "tar.gz": lambda: tar_of(*members, mode="w:gz"),
        "gzip of several members": lambda: b"".join(
            gzip.compress(tar[at : at + 9000]) for at in range(0, len(tar), 9000)
        ),
    }[kind]()
    (tmp_path / "upload").write_bytes(data)
    assert is_archive(tmp_path / "upload")
    assert set(extract_archive(tmp_path / "upload", tmp_path / "out")) == set(files)
    assert {name: (tmp_path / "out" / name).read_bytes() for name in files} == files
    assert len([path for path in (tmp_path / "out").rglob("*") if path.is_file()]) == len(files)


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), min_size=1, max_size=30)


@settings(max_examples=60, deadline=None)
@given(names=st.lists(NAMES, min_size=1, max_size=4), cut=st.integers(0, 3000))
def test_no_name_nor_cut_writes_outside(names: list[str], cut: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    root = tmp_path_factory.mktemp("any")
    data = tar_of(*((name, b"1") for name in names))
    (root / "upload").write_bytes(data[: len(data) - cut])
    try:
        written = extract_archive(root / "upload", root / "out")
    except InputError:
        assert list((root / "out").iterdir()) == []
    else:
        assert all((root / "out" / name).resolve().is_relative_to((root / "out").resolve()) for name in written)
    assert sorted(path.name for path in root.iterdir()) == ["out", "upload"]


class Unflagged(zipfile.ZipInfo):
    """A name whose bytes are ``raw``, without the flag that says that they are UTF-8."""

    def __init__(self, raw: bytes) -> None:
        super().__init__(f"x{raw.hex()}")
        self.raw = raw

    def _encodeFilenameFlags(self) -> tuple[bytes, int]:
        return self.raw, 0


def unflagged_zip(*names: bytes, system: int = 3, extra: bytes = b"") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for number, name in enumerate(names):
            info = Unflagged(name)
            info.create_system, info.extra = system, extra
            archive.writestr(info, bytes([number]))
    return buffer.getvalue()


def unpacked(data: bytes, folder: Path, limits: ArchiveLimits = LIMITS) -> tuple[str, ...]:
    folder.mkdir(exist_ok=True)
    (folder / "upload").write_bytes(data)
    assert is_archive(folder / "upload")
    return extract_archive(folder / "upload", folder / "out", limits)


def refused(data: bytes, folder: Path, limits: ArchiveLimits = LIMITS) -> tuple[str, ...]:
    with pytest.raises(InputError) as caught:
        unpacked(data, folder, limits)
    assert caught.value.subject == "archive"
    assert not [*(folder / "out").glob("*")]
    return tuple(texts_of(caught.value.faults))


def packed(kind: str, names: list[str]) -> bytes:
    members = [(name, b"1") for name in names]
    if kind == "zip of macOS":
        return unflagged_zip(*(name.encode() for name in names))
    forms = {"pax": tarfile.PAX_FORMAT, "gnu": tarfile.GNU_FORMAT}
    return zip_of(*members) if kind == "zip" else tar_of(*members, form=forms[kind])


@pytest.mark.parametrize("kind", ["zip", "zip of macOS", "pax", "gnu"])
@pytest.mark.parametrize("folder", FOLDERS)
def test_the_folder_around_a_capture_may_have_any_name(folder: str, kind: str, tmp_path: Path) -> None:
    names = [f"{FOLDERS[folder]}/{member}" for member in MEMBERS]
    junk = [f"__MACOSX/{FOLDERS[folder]}/._cam00.png", f"{FOLDERS[folder]}/THUMBS.DB"]
    assert unpacked(packed(kind, [*names, *junk]), tmp_path) == tuple(names)
    assert all((tmp_path / "out" / name).is_file() for name in names)


@pytest.mark.parametrize("kind", ["zip of macOS", "pax"])
def test_names_that_are_kept_are_judged(kind: str, tmp_path: Path) -> None:
    names = ["頭/cameras.json", "頭/images/c\u0430m00.png"]
    assert refused(packed(kind, names), tmp_path) == (
        "'頭/images/c\u0430m00.png' mixes letters of several alphabets in its name: rename it",
    )


@pytest.mark.parametrize("name", ["Камера.png", "images/Камера_cam00.JPG", "写真1.png", "Φωτό 1.tif", "cam00 Ω.png"])
def test_letters_of_several_alphabets_may_stand_side_by_side(name: str, tmp_path: Path) -> None:
    assert unpacked(packed("zip of macOS", ["cameras.json", name]), tmp_path) == ("cameras.json", name)


@pytest.mark.parametrize(
    ("encoding", "text"),
    [
        ("cp437", "Anna Müller"),
        ("shift_jis", "頭スキャン"),
        ("gbk", "扫描张伟"),
        ("cp1251", "Скан головы"),
        ("euc_kr", "머리스캔"),
    ],
)
def test_a_folder_in_another_code_page_is_read_all_the_same(encoding: str, text: str, tmp_path: Path) -> None:
    names = unpacked(unflagged_zip(*(f"{text}/{member}".encode(encoding) for member in MEMBERS)), tmp_path)
    assert [name.split("/", 1)[1] for name in names] == list(MEMBERS)
    assert names[0].startswith(text) == (encoding == "cp437"), "the code page of the format"


@pytest.mark.parametrize("kind", ["zip", "gnu"])
def test_a_kept_name_in_an_unknown_encoding_is_not_shown_garbled(kind: str, tmp_path: Path) -> None:
    raw = "images/\u043a\u0430Cam00.png".encode("cp1251")  # in code page 437 Greek before Latin letters
    if kind == "zip":
        data = unflagged_zip(b"cameras.json", raw)
    else:
        name = raw.decode("utf-8", "surrogateescape")
        data = tar_of(("cameras.json", b""), (name, b""), form=tarfile.GNU_FORMAT)
    assert refused(data, tmp_path) == (
        "'images/??Cam00.png' has letters in an encoding that the archive does not state: pack it with names in UTF-8, "
        "or rename it",
    )


def test_the_name_in_utf_8_that_info_zip_writes_beside_another_is_taken(tmp_path: Path) -> None:
    raw, name = "Müller/a.png".encode("latin-1"), "Müller/a.png".encode()
    field = b"\1" + zlib.crc32(raw).to_bytes(4, "little") + name
    extra = struct.pack("<HH", 0x5455, 1) + b"\0" + struct.pack("<HH", 0x7075, len(field)) + field
    assert unpacked(unflagged_zip(raw, extra=extra), tmp_path) == ("Müller/a.png",)
    other = extra.replace(field[1:5], b"\0\0\0\0")  # of another name: not believed
    assert unpacked(unflagged_zip(raw, extra=other), tmp_path / "more") != ("Müller/a.png",)


def test_backslashes_of_windows_are_slashes_where_no_name_has_one(tmp_path: Path) -> None:
    names = (b"anna\\cameras.json", b"anna\\images\\cam00.png")
    assert unpacked(unflagged_zip(*names, system=0), tmp_path) == ("anna/cameras.json", "anna/images/cam00.png")
    for number, names in enumerate([(b"a\\..\\..\\x",), (b"a\\b", b"a/c"), (b"C:\\x",)]):
        (fault,) = refused(unflagged_zip(*names, system=0), tmp_path / str(number))
        assert "leads out" in fault or "backslash or a drive letter" in fault


def old_tar(*names: str) -> bytes:
    """As V7 of Unix wrote it: neither sign nor version, and no names of users."""
    data = bytearray()
    for name in names:
        info = tarfile.TarInfo(name)
        info.size = 3
        block = bytearray(info.tobuf(tarfile.USTAR_FORMAT))
        block[257:512] = bytes(255)
        block[148:156] = b" " * 8
        block[148:156] = b"%06o\0 " % sum(block)
        data += block + b"old".ljust(512, b"\0")
    return bytes(data) + bytes(1024)


@pytest.mark.parametrize("packing", [bytes, gzip.compress])
def test_a_tar_of_before_posix_is_read_and_what_only_looks_like_one_is_not(packing: type, tmp_path: Path) -> None:
    data = packing(old_tar("頭/cameras.json", "頭/images/cam00.png"))
    assert unpacked(data, tmp_path) == ("頭/cameras.json", "頭/images/cam00.png")
    for data in (bytes(1024), b"text" * 256, bytes(range(256)) * 4):
        (tmp_path / "upload").write_bytes(data)
        assert not is_archive(tmp_path / "upload")


@pytest.mark.parametrize(
    ("sign", "word"),
    [(b"7z\xbc\xaf'\x1c", "7-Zip"), (b"Rar!\x1a\x07\x01\0", "RAR"), (b"\xfd7zXZ\0", "xz"), (b"BZh91AY", "bzip2")],
)
def test_an_archive_of_another_kind_is_called_what_it_is(sign: bytes, word: str, tmp_path: Path) -> None:
    (tmp_path / "upload").write_bytes(sign + bytes(600))
    with pytest.raises(InputError, match=f"is packed by {word}, which is not read: pack the folder as .zip"):
        extract_archive(tmp_path / "upload", tmp_path / "out")


@pytest.mark.parametrize("character", ["\ue000", "\u0378", "\u2028", "\u2029", "\u200b", "\u202e", "\n", "\x7f"])
def test_characters_that_nobody_sees_are_refused(character: str, tmp_path: Path) -> None:
    (fault,) = refused(tar_of((f"a{character}b", b""), form=tarfile.GNU_FORMAT), tmp_path)
    assert fault.endswith(" has an invisible or control character in its name: rename it")


@pytest.mark.parametrize(
    ("limits", "right", "wrong"),
    [
        (ArchiveLimits(members=3), [("a", b""), ("b", b""), ("c", b"")], [(name, b"") for name in "abcd"]),
        (ArchiveLimits(member_bytes=9), [("a", b"123456789")], [("a", b"1234567890")]),
        (ArchiveLimits(total_bytes=9), [("a", b"12345"), ("b", b"6789")], [("a", b"12345"), ("b", b"67890")]),
        (ArchiveLimits(total_bytes=0), [("a", b""), ("b", b"")], [("a", b"1")]),
        (ArchiveLimits(depth=3), [("a/b/c", b"1")], [("a/b/c/d", b"1")]),
        (ArchiveLimits(name_length=4), [("abcd/\u00e4\u00f6", b"1")], [("abcd/a\u00e4\u00f6", b"1")]),
    ],
    ids=["members", "member_bytes", "total_bytes", "empty", "depth", "name_length"],
)
def test_a_limit_is_the_most_that_passes(
    limits: ArchiveLimits, right: list[tuple[str, bytes]], wrong: list[tuple[str, bytes]], tmp_path: Path
) -> None:
    for kind, pack in (("zip", zip_of), ("tar", tar_of)):
        folder = tmp_path / kind
        assert unpacked(pack(*right), folder, limits) == tuple(name for name, _ in right)
        assert len(refused(pack(*wrong), folder / "wrong", limits)) == 1


def test_the_ratio_counts_only_above_its_floor(tmp_path: Path) -> None:
    data = zip_of(("a", bytes(100_000)))
    tight = ArchiveLimits(ratio=2.0, ratio_floor_bytes=99_999)
    assert refused(data, tmp_path, tight)[0].startswith("the archive unpacks to more than is allowed: ")
    assert unpacked(data, tmp_path, ArchiveLimits(ratio=2.0, ratio_floor_bytes=100_000)) == ("a",)
    incompressible = ArchiveLimits(ratio=1.0, ratio_floor_bytes=0)
    stored = zip_of(("b", bytes(5000)), method=zipfile.ZIP_STORED)
    assert unpacked(stored, tmp_path / "more", incompressible) == ("b",)


def test_one_fault_of_many_members_is_said_once_and_the_hundredth_is_the_last(tmp_path: Path) -> None:
    def clashing(count: int) -> bytes:  # each names another file, so that none is like the one before
        return tar_of(*((f"{letter}{i}", b"") for i in range(count) for letter in "xX"))

    assert len(refused(clashing(100), tmp_path)) == 100
    assert refused(clashing(101), tmp_path)[100:] == ("and 1 more faults",)
    (fault,) = refused(tar_of(*((f"../{i}", b"") for i in range(36))), tmp_path)
    assert fault == "'../0' leads out of the archive ('..'); the same is true of 35 more members"


def test_folders_dots_and_what_file_managers_add_are_passed_over(tmp_path: Path) -> None:
    names = [("x/", b""), ("./x/y/a", b"1"), ("._a", b"2"), ("x/desktop.ini", b"3"), ("x/y/b", b"4"), ("x/y/", b"")]
    assert unpacked(zip_of(*names), tmp_path) == ("x/y/a", "x/y/b")
    folders = [(tar_entry("x", tarfile.DIRTYPE), b""), ("./x/y/a", b"1"), ("._a", b"2"), ("x/y/b", b"4")]
    assert unpacked(tar_of(*folders), tmp_path / "tar") == ("x/y/a", "x/y/b")
    assert (tmp_path / "tar" / "out" / "x" / "y" / "a").read_bytes() == b"1"
    unix = [(zip_entry("x", stat.S_IFDIR | 0o755), b""), ("x/a", b"1")]
    assert unpacked(zip_of(*unix), tmp_path / "unix") == ("x/a",)


def test_it_unpacks_into_a_folder_that_is_there_or_is_not_yet(tmp_path: Path) -> None:
    (tmp_path / "upload").write_bytes(tar_of(("a", b"1")))
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "one" / "two"):
        assert extract_archive(tmp_path / "upload", folder) == ("a",)
    (tmp_path / "one" / "two" / "b").mkdir()
    with pytest.raises(InputError) as caught:
        extract_archive(tmp_path / "upload", tmp_path / "one" / "two")
    assert caught.value.subject == "two"
    assert texts_of(caught.value.faults) == ["the folder is not empty; an archive is unpacked into a folder of its own"]


def test_a_list_of_members_has_a_limit_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = zip_of(("a", b"1"))
    size = 46 + 1  # an entry of the list and its name
    monkeypatch.setattr(rules, "DIRECTORY_BYTES_MOST", size)
    assert unpacked(data, tmp_path) == ("a",)
    monkeypatch.setattr(rules, "DIRECTORY_BYTES_MOST", size - 1)
    (fault,) = refused(data, tmp_path / "more")
    assert fault == f"the archive has a list of members {size} bytes long: too many members"


def test_a_long_name_s_header_has_a_limit_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tar_of(("a/" * 55 + "b", b""), form=tarfile.GNU_FORMAT)  # 111 bytes and a zero
    monkeypatch.setattr(rules, "HEADER_BYTES_MOST", 112)
    assert len(unpacked(data, tmp_path, ArchiveLimits(depth=60))) == 1
    monkeypatch.setattr(rules, "HEADER_BYTES_MOST", 111)
    assert refused(data, tmp_path / "more") == ("'././@LongLink' has a header of 112 bytes, which is too large",)
