"""The rules of archives to the letter: what is said of each fault, and where each limit lies."""

import io
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from rig.errors import InputError
from rig.formats.captures import archive as rules
from rig.formats.captures.archive import ArchiveLimits, extract_archive
from rig.messages.message import texts_of
from tests.rig.formats.captures.test_archive import tar_entry, tar_of, zip_entry, zip_of

LIMITS = ArchiveLimits()


def refused(data: bytes, folder: Path, limits: ArchiveLimits = LIMITS) -> tuple[str, ...]:
    (folder / "upload").write_bytes(data)
    with pytest.raises(InputError) as caught:
        extract_archive(folder / "upload", folder / "out", limits)
    assert caught.value.subject == "archive"
    return tuple(texts_of(caught.value.faults))


def unpacked(data: bytes, folder: Path, limits: ArchiveLimits = LIMITS) -> tuple[str, ...]:
    (folder / "upload").write_bytes(data)
    return extract_archive(folder / "upload", folder / "out", limits)


@pytest.mark.parametrize("character", ["\ue000", "\u0378", "\u2028", "\u2029", "\u200b", "\x7f"])
def test_characters_that_nobody_sees_are_refused(character: str, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT, errors="surrogateescape") as archive:
        archive.addfile(tarfile.TarInfo(f"a{character}b"))
    (fault,) = refused(buffer.getvalue(), tmp_path)
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
        folder.mkdir()
        assert unpacked(pack(*right), folder, limits) == tuple(name for name, _ in right)
        (folder / "wrong").mkdir()
        assert len(refused(pack(*wrong), folder / "wrong", limits)) == 1


def test_the_ratio_counts_only_above_its_floor(tmp_path: Path) -> None:
    data = zip_of(("a", bytes(100_000)))
    tight = ArchiveLimits(ratio=2.0, ratio_floor_bytes=99_999)
    assert refused(data, tmp_path, tight)[0].startswith("unpacks to more than is allowed: ")
    assert unpacked(data, tmp_path, ArchiveLimits(ratio=2.0, ratio_floor_bytes=100_000)) == ("a",)
    incompressible = ArchiveLimits(ratio=1.0, ratio_floor_bytes=0)
    stored = zip_of(("b", bytes(5000)), method=zipfile.ZIP_STORED)
    (tmp_path / "more").mkdir()
    assert unpacked(stored, tmp_path / "more", incompressible) == ("b",)


def test_a_file_of_several_blocks_comes_out_whole(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10_000
    assert len(data) > 2 * rules.COPY_BYTES
    assert unpacked(zip_of(("a", data)), tmp_path) == ("a",)
    assert (tmp_path / "out" / "a").read_bytes() == data


def test_the_hundredth_fault_is_the_last_that_is_named(tmp_path: Path) -> None:
    def clashing(count: int) -> bytes:  # each names another file, so that none is like the one before
        return tar_of(*((f"{letter}{i}", b"") for i in range(count) for letter in "xX"))

    assert len(refused(clashing(100), tmp_path)) == 100
    assert refused(clashing(101), tmp_path)[100:] == ("and 1 more faults",)


def test_one_fault_of_many_members_is_said_once(tmp_path: Path) -> None:
    (fault,) = refused(tar_of(*((f"../{i}", b"") for i in range(36))), tmp_path)
    assert fault == "'../0' leads out of the archive ('..'); the same is true of 35 more members"


def test_folders_dots_and_what_file_managers_add_are_passed_over(tmp_path: Path) -> None:
    names = [("x/", b""), ("./x/y/a", b"1"), ("._a", b"2"), ("x/desktop.ini", b"3"), ("x/y/b", b"4"), ("x/y/", b"")]
    assert unpacked(zip_of(*names), tmp_path) == ("x/y/a", "x/y/b")
    (tmp_path / "tar").mkdir()
    folders = [(tar_entry("x", tarfile.DIRTYPE), b""), ("./x/y/a", b"1"), ("._a", b"2"), ("x/y/b", b"4")]
    assert unpacked(tar_of(*folders), tmp_path / "tar") == ("x/y/a", "x/y/b")
    assert (tmp_path / "tar" / "out" / "x" / "y" / "a").read_bytes() == b"1"
    (tmp_path / "unix").mkdir()
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
    assert texts_of(caught.value.faults) == ["is not empty; an archive is unpacked into a folder of its own"]


def test_a_list_of_members_has_a_limit_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = zip_of(("a", b"1"))
    size = 46 + 1  # an entry of the list and its name
    monkeypatch.setattr(rules, "DIRECTORY_BYTES_MOST", size)
    assert unpacked(data, tmp_path) == ("a",)
    monkeypatch.setattr(rules, "DIRECTORY_BYTES_MOST", size - 1)
    (tmp_path / "more").mkdir()
    (fault,) = refused(data, tmp_path / "more")
    assert fault == f"has a list of members {size} bytes long: too many members"


def test_a_long_name_s_header_has_a_limit_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT) as archive:
        archive.addfile(tarfile.TarInfo("a/" * 55 + "b"))  # 111 bytes and a zero
    monkeypatch.setattr(rules, "HEADER_BYTES_MOST", 112)
    assert len(unpacked(buffer.getvalue(), tmp_path, ArchiveLimits(depth=60))) == 1
    monkeypatch.setattr(rules, "HEADER_BYTES_MOST", 111)
    (tmp_path / "more").mkdir()
    assert refused(buffer.getvalue(), tmp_path / "more") == ("'././@LongLink' has a header of 112 bytes",)
