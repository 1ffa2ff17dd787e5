"""Hostile and honest archives: each refusal names its member, and leaves the folder as it was."""

import gzip
import io
import stat
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.errors import InputError
from rig.formats.captures.archive import ArchiveLimits, extract_archive, is_archive


def zip_of(*members: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in members:
            archive.writestr(name, data, compress_type=method)
    return buffer.getvalue()


def tar_of(*members: tuple[str | tarfile.TarInfo, bytes], mode: str = "w") -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as archive:  # type: ignore[call-overload]
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


KINDS = "; only files and folders are unpacked"
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
    "tar kind": (lambda: tar_of((tar_entry("a.png", b"Q"), b"")), "'a.png' is of a kind (b'Q') that is not unpacked"),
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
    "right to left": (lambda: tar_of(("images/cam\u202egnp.exe", b"1")), "invisible"),
    "zero width": (lambda: tar_of(("images/cam\u200b00.png", b"1")), "invisible"),
    "newline": (lambda: tar_of(("images/cam\n00.png", b"1")), "invisible or control"),
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


@pytest.mark.parametrize("kind", ["zip", "stored zip", "tar", "tar.gz"])
def test_an_honest_archive_comes_out_whole(kind: str, tmp_path: Path) -> None:
    files = {
        "Müller/cameras.json": b"{}",
        "Müller/images/cam00.png": bytes(range(256)) * 9,
        "Müller/images/leer.png": b"",
    }
    junk = [
        ("__MACOSX/Müller/._cam00.png", b"junk"),
        ("Müller/.DS_Store", b"junk"),
        ("Müller/images/Thumbs.db", b"junk"),
    ]
    members = [*files.items(), *junk]
    data = {
        "zip": lambda: zip_of(*members),
        "stored zip": lambda: zip_of(*members, method=zipfile.ZIP_STORED),
        "tar": lambda: tar_of(*members),
        "tar.gz": lambda: tar_of(*members, mode="w:gz"),
    }[kind]()
    (tmp_path / "upload").write_bytes(data)
    assert is_archive(tmp_path / "upload")
    assert set(extract_archive(tmp_path / "upload", tmp_path / "out")) == set(files)
    assert {name: (tmp_path / "out" / name).read_bytes() for name in files} == files
    assert len([path for path in (tmp_path / "out").rglob("*") if path.is_file()]) == len(files)


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), min_size=1, max_size=30)


@settings(max_examples=60, deadline=None)
@given(names=st.lists(NAMES, min_size=1, max_size=4), cut=st.integers(0, 3000))
def test_no_name_and_no_cut_writes_outside_or_raises_anything_else(
    names: list[str], cut: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
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
