"""The contact sheet: one file, colours by what is told, nothing of others in its markup."""

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.results.overlays import AZIMUTHS_DEG
from pipeline.warnings import WARNING_CODES
from rig.messages.message import MessageDocument
from server.batch.sheet import PANEL_PX, REMARKS, SEVERE, Card, card_class, figures_of, severity, sheet_lines, views_of
from tests.support.pinned_work import picture_bytes
from tests.support.services import ROOT


def messages(*codes: str) -> tuple[MessageDocument, ...]:
    return tuple(MessageDocument(code=code, message=f"words of {code}") for code in codes)


def card(name: str, state: str = "done", *codes: str, turntable: Path | None = None) -> Card:
    return Card(name, "S01", state, "breadth 150.0 mm", messages(*codes), turntable, f"{name}/")


class Found(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_the_sheet_needs_nothing_beside_it(tmp_path: Path) -> None:
    found, turntable = Found(), tmp_path / "turntable.png"
    turntable.write_bytes(picture_bytes(bytes(range(9))))
    cards = [card("a", turntable=turntable), card("b", "failed", "input-refused"), card("c", turntable=tmp_path / "no")]
    found.feed("\n".join(sheet_lines("study", cards)))
    (picture,) = [attributes for tag, attributes in found.tags if tag == "img"]
    assert picture["src"] == "data:image/jpeg;base64," + base64.b64encode(views_of(turntable) or b"").decode()
    assert {tag for tag, _ in found.tags} & {"script", "link", "iframe"} == set()
    assert [attributes["href"] for tag, attributes in found.tags if tag == "a"] == ["a/", "c/"]


def test_names_and_messages_are_text() -> None:
    hostile = Card("<script>x</script>&", "<b>", "failed", "", messages("<i>"), None, "x")
    found = Found()
    page = "\n".join(sheet_lines("<script>", [hostile]))
    found.feed(page)
    assert {tag for tag, _ in found.tags} & {"script", "b", "i"} == set()
    assert "&lt;script&gt;x&lt;/script&gt;&amp;" in page


def test_what_needs_a_look_comes_first_and_is_counted() -> None:
    cards = [
        card("missing", "missing"),
        card("good"),
        card("remark", "done", "file-unread"),
        card("warned", "done", "view"),
        card("wrong", "done", "view", "pose-doubtful"),
        card("failed", "failed", "input-refused"),
    ]
    assert [card_class(each) for each in cards] == ["missing", "good", "good", "warning", "severe", "failed"]
    page = "\n".join(sheet_lines("study", cards))
    assert re.findall(r"<h2>(?:<a[^>]*>)?(\w+)", page) == ["failed", "wrong", "warned", "good", "remark", "missing"]
    assert "6 captures: 2 without a warning that matters, 1 with warnings, 1 that may be wrong, 1 failed" in page
    assert page.index("pose-doubtful") < page.index("words of view")  # the worst first, within a card too


def test_every_code_that_has_a_colour_is_one() -> None:
    assert set(WARNING_CODES) >= SEVERE | REMARKS
    assert not SEVERE & REMARKS
    assert [severity(code) for code in ("pose-doubtful", "no-bust", "file-unread")] == ["severe", "warning", "remark"]
    operator = (ROOT / "docs" / "operator.md").read_text(encoding="utf-8")
    assert all(code in operator for code in SEVERE)


def test_thumbnails_are_the_right_side_the_front_and_the_left(tmp_path: Path) -> None:
    count = len(AZIMUTHS_DEG)
    shades = np.repeat(np.arange(count, dtype=np.uint8) * 20 + 20, 280)
    drawn = np.repeat(np.tile(shades, (360, 1))[..., None], 3, axis=2)
    cv2.imwrite(str(tmp_path / "turntable.png"), drawn)
    data = views_of(tmp_path / "turntable.png")
    assert data is not None
    small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert small is not None
    assert small.shape == (PANEL_PX[1], 3 * PANEL_PX[0])
    means = [float(panel.mean()) for panel in np.split(small, 3, axis=1)]
    assert means == pytest.approx([20, 20 + 20 * (count // 2), 20 * count], abs=2)
    assert views_of(tmp_path / "none.png") is None


def test_figures_in_words() -> None:
    assert figures_of({"head_breadth_mm": 151.26, "head_length_mm": None, "quality_median_mm": 0.44}) == (
        "breadth 151.3 mm, deviation 0.4 mm"
    )
