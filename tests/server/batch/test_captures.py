"""Captures below a folder and in lists, every fault of a list at once; shares are one whole, alike everywhere; a
capture's digest is of its names and bytes."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import InputError
from rig.formats.captures.archive import pack_folder
from rig.messages.message import texts_of
from server.batch.captures import WHOLE, BatchCapture, Shard, capture_sha256, find_captures, read_list, read_shard
from tests.support.services import small_capture


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as caught:
        read_list(path)
    return texts_of(caught.value.faults)


@pytest.fixture
def shots(tmp_path: Path) -> Path:
    """Two captures in one session, one packed, photographs alone, and much that is none."""
    folder = tmp_path / "shots"
    small_capture(folder / "monday" / "anna")
    small_capture(folder / "monday" / "bert", seed=1)
    small_capture(folder / "packed")
    pack_folder(folder / "packed", folder / "carl.tar.gz")
    (folder / "packed").rename(tmp_path / "elsewhere")
    pictures = [f"{place}/{name}.jpg" for place in ("photos", "background") for name in "abc"]
    documents = ["anna.truth/cameras.json", ".hidden/cameras.json", "old-result/report.json"]
    for name in (*pictures, *documents, "notes/lamp.jpg", "old-result/overlays/cam00.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")
    return folder


def test_captures_are_found_below_a_folder_and_nothing_else(shots: Path) -> None:
    (shots / "heads" / "images").mkdir(parents=True)
    found = find_captures(shots, shots / "heads")
    assert [capture.name for capture in found] == ["carl", "monday/anna", "monday/bert", "photos"]
    assert found[1] == BatchCapture("monday/anna", shots / "monday" / "anna")


def test_a_folder_without_captures_and_one_that_is_a_capture_are_refused(shots: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a capture itself: name the folder above it"):
        find_captures(shots / "monday" / "anna", tmp_path / "out")
    with pytest.raises(InputError, match="notes: the folder holds no capture"):
        find_captures(shots / "notes", tmp_path / "out")


def test_a_folder_and_its_archive_would_be_one_result(shots: Path) -> None:
    small_capture(shots / "carl")
    with pytest.raises(InputError, match=r"carl, carl\.tar\.gz have the same name, carl"):
        find_captures(shots, shots / "heads")


def test_a_plain_list_counts_from_where_it_lies(shots: Path) -> None:
    (shots / "list.txt").write_text("# the first day\nmonday/bert\n\n  carl.tar.gz  \n")
    assert [(c.name, c.path) for c in read_list(shots / "list.txt")] == [
        ("monday/bert", shots / "monday" / "bert"),
        ("carl", shots / "carl.tar.gz"),
    ]


def test_a_csv_says_subject_session_name_and_settings(shots: Path, tmp_path: Path) -> None:
    (shots / "deep.toml").write_text('detail = "photo"\n')
    (shots / "study.csv").write_text(
        "subject,capture,settings,session,name\n"
        "S01,monday/anna,deep.toml,day 1,\n"
        f'"S02, twin",{tmp_path / "elsewhere"},"{{""front"": ""cam01""}}",day 2,twins/s02\n'
        "# S03 did not come,,,,\n"
        "S04,carl.tar.gz\n",
        encoding="utf-8-sig",
    )
    anna, twin, carl = read_list(shots / "study.csv")
    assert (anna.name, anna.subject, anna.session, dict(anna.settings)) == (
        "monday/anna", "S01", "day 1", {"detail": "photo"},
    )  # fmt: skip
    assert (twin.name, twin.subject, dict(twin.settings)) == ("twins/s02", "S02, twin", {"front": "cam01"})
    assert (carl.name, carl.subject, carl.session, dict(carl.settings)) == ("carl", "S04", "", {})


def test_every_fault_of_a_list_is_named_with_its_line(shots: Path) -> None:
    (shots / "study.csv").write_text(
        "capture,subject,name,settings\n"
        "monday/anna,S01,,\n"
        "monday/gone,S02,,\n"
        "notes/lamp.jpg,S03,,\n"
        ",S04,,\n"
        "monday/bert,S05,monday/anna,{\n"
        "carl.tar.gz,S06,../up,no.toml\n"
        "photos,S07,,,,\n"
        "photos,S08,monday/anna/deep,[]\n"
    )
    faults = faults_of(shots / "study.csv")
    for line, words in [
        (3, f"{shots / 'monday/gone'} is not there"),
        (4, "lamp.jpg is not a capture"),
        (5, "the row names no capture"),
        (6, "settings: the text is no JSON"),
        (7, "no.toml: the content cannot be read"),
        (8, "the row has 6 cells, but the first row names 4 columns"),
        (9, "[]: the content cannot be read"),
    ]:
        assert [fault for fault in faults if fault.startswith(f"line {line}: ") and words in fault], (line, faults)
    assert "line 2, line 6 have the same name, monday/anna: write another one in the column name" in faults
    assert [fault for fault in faults if fault.startswith("line 7: '../up' cannot name a folder")]
    assert [
        fault for fault in faults if fault.startswith("monday/anna/deep would lie within the result of monday/anna")
    ]
    assert len(faults) == 10


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("capture,sesion\n.,x\n", "no column 'sesion' is known; did you mean session?"),
        ("capture,zzz\n.,x\n", "no column 'zzz' is known; there are capture, name, subject, session, settings"),
        ("subject,name\nx,y\n", "no column is called capture; the first row names subject, name"),
        ("capture,capture\n.,.\n", "the column capture is named twice"),
        ("", "the list names no capture"),
        ("capture\n", "the list names no capture"),
    ],
)
def test_a_wrong_first_row_is_named(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "study.csv").write_text(text)
    assert fault in faults_of(tmp_path / "study.csv")


@pytest.mark.parametrize("name", ["heads.csv", "sheet.html", "sheet.pdf", ".batch", "a//b", "a/.b", "a\\b", "/a"])
def test_names_that_would_be_other_files_are_refused(tmp_path: Path, name: str) -> None:
    small_capture(tmp_path / "anna")
    (tmp_path / "study.csv").write_text(f"capture,name\nanna,{name}\n")
    assert "cannot name a folder of results" in " ".join(faults_of(tmp_path / "study.csv"))


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "study.csv").write_bytes(b"\xff\xfe\x00")
    assert "cannot be read" in faults_of(tmp_path / "study.csv")[0]


@given(st.text(), st.integers(1, 50))
def test_each_name_is_of_exactly_one_share(name: str, count: int) -> None:
    assert sum(Shard(number, count).takes(name) for number in range(1, count + 1)) == 1
    assert WHOLE.takes(name)


def test_the_hash_stays_what_it_is() -> None:
    """A batch that is half done goes on with a later version: the shares must not move."""
    assert [[k for k in range(20) if Shard(number, 3).takes(f"s{k:02}")] for number in (1, 2, 3)] == [
        [3, 7, 12, 14, 15],
        [0, 4, 6, 9, 16, 19],
        [1, 2, 5, 8, 10, 11, 13, 17, 18],
    ]


def test_shares_are_about_equal() -> None:
    counts = [sum(Shard(number, 8).takes(f"capture-{k}") for k in range(4000)) for number in range(1, 9)]
    # Binomial(4000, 1/8): 500 with a standard deviation of 21
    assert max(abs(count - 500) for count in counts) < 4 * 21


@pytest.mark.parametrize(("text", "shard"), [("1/1", WHOLE), ("3/8", Shard(3, 8)), (" 8/8 ", Shard(8, 8))])
def test_a_share_is_read(text: str, shard: Shard) -> None:
    assert read_shard(text) == shard
    assert read_shard(str(shard)) == shard


@pytest.mark.parametrize("text", ["", "0/8", "9/8", "1/0", "a/b", "1", "1/8/2", "-1/8", "1.5/2", "٣/8", "1/1000000"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="is no share such as 2/8"):
        read_shard(text)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    for name in ("images/cam00.png", "images/cam01.png", "cameras.json"):
        (tmp_path / "anna" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "anna" / name).write_text(name)
    return tmp_path / "anna"


def test_names_and_bytes_count_and_times_and_junk_do_not(capture: Path) -> None:
    before = capture_sha256(capture)
    os.utime(capture / "cameras.json", (0, 0))
    (capture / ".DS_Store").write_text("junk")
    (capture / "images" / "Thumbs.db").write_text("junk")
    assert capture_sha256(capture) == before
    (capture / "images" / "cam00.png").rename(capture / "images" / "cam02.png")
    renamed = capture_sha256(capture)
    (capture / "cameras.json").write_text("other")
    assert len({before, renamed, capture_sha256(capture)}) == 3


def test_where_bytes_are_cut_between_files_counts(tmp_path: Path) -> None:
    for name, first, second in (("a", "xy", "z"), ("b", "x", "yz")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1").write_text(first)
        (tmp_path / name / "2").write_text(second)
    assert capture_sha256(tmp_path / "a") != capture_sha256(tmp_path / "b")


def test_files_behind_links_count_and_a_circle_ends(capture: Path, tmp_path: Path) -> None:
    before = capture_sha256(capture)
    (capture / "images").rename(tmp_path / "elsewhere")
    (capture / "images").symlink_to(tmp_path / "elsewhere")
    assert capture_sha256(capture) == before
    (capture / "images" / "again").symlink_to(capture)
    (capture / "itself").symlink_to("itself")
    assert capture_sha256(capture) == before
    (tmp_path / "itself").symlink_to("itself")
    assert capture in [found.path for found in find_captures(tmp_path, tmp_path / "itself")]


def test_an_archive_is_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(b"abc")
    assert capture_sha256(tmp_path / "a.zip") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    with pytest.raises(FileNotFoundError):
        capture_sha256(tmp_path / "gone")
