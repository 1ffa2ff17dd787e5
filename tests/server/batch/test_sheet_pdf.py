"""The contact sheet as PDF: its pages hold every card whole, and equal cards give equal bytes."""

import re
import zlib
from pathlib import Path

import pytest

from server.batch.sheet import Card
from server.batch.sheet_pdf import FAINT, INKS, sheet_pdf
from tests.server.batch.test_sheet import card, messages
from tests.support.pinned_work import picture_bytes


def pages(data: bytes) -> list[str]:
    """Drawing operators of each page, as text."""
    streams = [
        zlib.decompress(found) for found in re.findall(rb"FlateDecode[^>]*>>\nstream\n(.*?)\nendstream", data, re.S)
    ]
    return [text.decode("latin-1") for text in streams if b" re f" in text or b"BT" in text]


@pytest.fixture(scope="module")
def turntable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sheet") / "turntable.png"
    path.write_bytes(picture_bytes(bytes(range(9))))
    return path


def operator(ink: tuple[int, int, int]) -> str:
    return " ".join(f"{channel / 255:.4g}" for channel in ink)


def test_warnings_have_their_colours_and_names_their_text(turntable: Path) -> None:
    cards = [card("good", turntable=turntable), card("wrong (1)", "done", "pose-doubtful", "view", "file-unread")]
    (page,) = pages(sheet_pdf("Größe", cards))
    assert "Gr\xf6\xdfe" in page
    assert "2 captures: 1 without a warning that matters, 1 that may be wrong" in page
    assert "wrong \\(1\\)" in page
    assert page.index("pose-doubtful") < page.index("words of view") < page.index("file-unread")
    assert page.index("wrong \\(1\\)") < page.index("(good)")
    for ink in (INKS["severe"], INKS["good"], INKS["warning"], FAINT):
        assert f"{operator(ink)} rg" in page


def test_every_card_lies_on_a_page(turntable: Path) -> None:
    cards = [card(f"head{number:02d}", turntable=turntable) for number in range(13)]
    cards += [Card("bad", "", "failed", "", messages(*["a-code"] * 50), None, "")]
    drawn = pages(sheet_pdf("study", cards))
    assert len(drawn) == 2
    for page in drawn:
        lows = [float(y) for y in re.findall(r"BT [\d.]+ (-?[\d.]+) Td", page)]
        assert min(lows) > 15
    text = "".join(drawn)
    assert all(f"(head{number:02d})" in text for number in range(13))
    assert "and 44 more, in sheet.html" in text


def test_names_in_other_letters_are_drawn(turntable: Path) -> None:
    other = sheet_pdf("Анна", [Card("張偉", "Έλένη", "done", "", messages("view"), turntable, "")])
    assert "?" not in "".join(pages(other))
    assert other.count(b"/Subtype /Image") == 4  # title, name, subject and the views
