"""Names as programs of many countries write them, and archives as many programs pack them, come out right."""

import gzip
import io
import struct
import tarfile
import zipfile
import zlib
from pathlib import Path

import pytest

from rig.errors import InputError
from rig.formats.captures.archive import extract_archive, is_archive
from rig.messages.message import texts_of
from tests.rig.formats.captures.test_archive import tar_of, zip_of

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


def unpacked(data: bytes, folder: Path) -> tuple[str, ...]:
    (folder / "upload").write_bytes(data)
    assert is_archive(folder / "upload")
    return extract_archive(folder / "upload", folder / "out")


def refused(data: bytes, folder: Path) -> tuple[str, ...]:
    with pytest.raises(InputError) as caught:
        unpacked(data, folder)
    assert list((folder / "out").iterdir()) == []
    return tuple(texts_of(caught.value.faults))


def packed(kind: str, names: list[str]) -> bytes:
    if kind == "zip":
        return zip_of(*((name, b"1") for name in names))
    if kind == "zip of macOS":
        return unflagged_zip(*(name.encode() for name in names))
    form = {"pax": tarfile.PAX_FORMAT, "gnu": tarfile.GNU_FORMAT, "ustar": tarfile.USTAR_FORMAT}[kind]
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form, encoding="utf-8") as archive:
        for name in names:
            info = tarfile.TarInfo(name)
            info.size = 1
            archive.addfile(info, io.BytesIO(b"1"))
    return buffer.getvalue()


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


def test_bytes_that_are_no_utf_8_are_the_code_page_of_the_format(tmp_path: Path) -> None:
    names = [f"Anna Müller/{member}" for member in MEMBERS]
    assert unpacked(unflagged_zip(*(name.encode("cp437") for name in names)), tmp_path) == tuple(names)


@pytest.mark.parametrize("encoding", ["shift_jis", "gbk", "cp1251", "euc_kr"])
def test_a_folder_in_another_code_page_is_read_all_the_same(encoding: str, tmp_path: Path) -> None:
    text = {"shift_jis": "頭スキャン", "gbk": "扫描张伟", "cp1251": "Скан головы", "euc_kr": "머리스캔"}[encoding]
    names = [f"{text}/{member}".encode(encoding) for member in MEMBERS]
    assert [name.split("/", 1)[1] for name in unpacked(unflagged_zip(*names), tmp_path)] == list(MEMBERS)


@pytest.mark.parametrize("kind", ["zip", "gnu"])
def test_a_kept_name_in_an_unknown_encoding_is_not_shown_garbled(kind: str, tmp_path: Path) -> None:
    raw = "images/\u043a\u0430Cam00.png".encode("cp1251")  # in code page 437 Greek before Latin letters
    if kind == "zip":
        data = unflagged_zip(b"cameras.json", raw)
    else:
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT, errors="surrogateescape") as archive:
            for name in (b"cameras.json", raw):
                archive.addfile(tarfile.TarInfo(name.decode("utf-8", "surrogateescape")))
        data = buffer.getvalue()
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
    (tmp_path / "more").mkdir()
    assert unpacked(unflagged_zip(raw, extra=other), tmp_path / "more") != ("Müller/a.png",)


def test_backslashes_of_windows_are_slashes_where_no_name_has_one(tmp_path: Path) -> None:
    names = (b"anna\\cameras.json", b"anna\\images\\cam00.png")
    assert unpacked(unflagged_zip(*names, system=0), tmp_path) == ("anna/cameras.json", "anna/images/cam00.png")
    for number, names in enumerate([(b"a\\..\\..\\x",), (b"a\\b", b"a/c"), (b"C:\\x",)]):
        (tmp_path / str(number)).mkdir()
        (fault,) = refused(unflagged_zip(*names, system=0), tmp_path / str(number))
        assert "leads out" in fault or "backslash or a drive letter" in fault


def test_a_gzip_of_several_members_comes_out_whole(tmp_path: Path) -> None:
    tar = tar_of(*((f"images/cam{i:02}.png", bytes(range(256)) * 40) for i in range(6)))
    data = b"".join(gzip.compress(tar[at : at + 9000]) for at in range(0, len(tar), 9000))
    assert len(unpacked(data, tmp_path)) == 6
    assert (tmp_path / "out" / "images" / "cam05.png").read_bytes() == bytes(range(256)) * 40


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
def test_a_tar_of_before_posix_is_read(packing: type, tmp_path: Path) -> None:
    data = packing(old_tar("頭/cameras.json", "頭/images/cam00.png"))
    assert unpacked(data, tmp_path) == ("頭/cameras.json", "頭/images/cam00.png")


def test_what_only_looks_like_an_old_tar_is_none(tmp_path: Path) -> None:
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
