"""Draws the contact sheet of a batch as a PDF, to be printed or sent: the cards of ``server.batch.sheet``, two beside
each other on A4 pages.

The fonts of a PDF contain only Latin-1 letters. A name with letters outside Latin-1 is drawn as a picture; in messages
such letters become question marks. The sheet contains no times, so that equal results give equal bytes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import cast

import cv2
import numpy as np
from fpdf import FPDF

from pipeline.results.pdf_page import latin
from rig.formats.pictures.images import encode_image
from server.batch.sheet import (
    PANEL_PX,
    Card,
    card_class,
    message_class,
    ranked_cards,
    ranked_messages,
    summary,
    views_of,
)

Ink = tuple[int, int, int]
MARGIN_MM, GAP_MM, PAGE_MM = 12.0, 5.0, (210.0, 297.0)
CARD_MM = (PAGE_MM[0] - 2 * MARGIN_MM - GAP_MM) / 2
BAR_MM, PAD_MM = 1.4, 2.5
TEXT_MM = CARD_MM - BAR_MM - 2 * PAD_MM
FINE_PX = (2 * PANEL_PX[0], 2 * PANEL_PX[1])  # of a view: 200 dots an inch
LINE_OF_PT = 0.44  # height of a line, mm a point
MAX_MESSAGES, MAX_LINES = 6, 4  # of a card and of a message, so that each card fits a page
INK, FAINT, CARD = (29, 35, 42), (95, 103, 111), (246, 247, 248)
INKS: dict[str, Ink] = {
    "severe": (179, 38, 30), "failed": (179, 38, 30), "warning": (138, 90, 0), "remark": FAINT,
    "good": (31, 111, 67), "missing": (175, 181, 187),
}  # fmt: skip
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class _Line:
    """Holds a line of a card, whose first ``lead`` characters are bold, in ``ink``."""

    text: str
    size_pt: float
    ink: Ink = INK
    lead: int = 0

    @property
    def height_mm(self) -> float:
        return self.size_pt * LINE_OF_PT


def sheet_pdf(title: str, cards: Sequence[Card]) -> bytes:
    """Returns the sheet as PDF. Captures that need attention come first."""
    pdf = _Page(title)
    pdf.add_page()
    pdf.write_line(_Line(title, 15, lead=len(title)), MARGIN_MM, PAGE_MM[0] - 2 * MARGIN_MM)
    for text in pdf.wrapped(summary(cards), 9, PAGE_MM[0] - 2 * MARGIN_MM):
        pdf.write_line(_Line(text, 9, FAINT), MARGIN_MM, PAGE_MM[0] - 2 * MARGIN_MM)
    pdf.set_y(pdf.get_y() + 3)
    ranked = ranked_cards(cards)
    for first in range(0, len(ranked), 2):
        pdf.write_cards(ranked[first : first + 2])
    return bytes(pdf.output())


class _Page(FPDF):
    """Draws A4 pages with page numbers, and the parts of a card."""

    def __init__(self, title: str) -> None:
        super().__init__(unit="mm", format="A4")
        self.set_auto_page_break(False)
        self.set_margins(MARGIN_MM, MARGIN_MM, MARGIN_MM)
        self.c_margin = 0.0
        self.set_creation_date(EPOCH)
        self.set_title(title)
        self.alias_nb_pages("{pages}")

    def footer(self) -> None:
        """Writes the page's number."""
        self.set_y(-9)
        self.set_font("Helvetica", size=8)
        self.set_text_color(*FAINT)
        self.cell(0, 4, f"{self.page_no()} / {{pages}}", align="R")

    def wrapped(self, text: str, size_pt: float, width_mm: float) -> list[str]:
        """Returns the text's lines, of ``width_mm`` at most, in Latin-1."""
        self.set_font("Helvetica", style="B", size=size_pt)  # the wider one
        lines = self.multi_cell(width_mm, text=latin(text), align="L", dry_run=True, output="LINES")
        return cast(list[str], lines)

    def write_line(self, line: _Line, x: float, width_mm: float) -> None:
        """Writes one line at the cursor, and moves the cursor below the line."""
        y = self.get_y()
        if latin(line.text) == line.text:
            self.set_xy(x, y)
            for part, style, ink in (
                (line.text[: line.lead], "B", line.ink),
                (line.text[line.lead :], "", INK if line.lead else line.ink),
            ):
                self.set_font("Helvetica", style=style, size=line.size_pt)
                self.set_text_color(*ink)
                if part:  # a cell of no width would reach to the margin
                    self.cell(self.get_string_width(part), line.height_mm, part)
        else:
            picture, scale = _drawn(line.text, line.ink, bold=line.lead > 0)
            width = min(picture.shape[1] * scale * line.height_mm, width_mm)
            self.image(encode_image(".png", picture), x, y, w=width, h=width * picture.shape[0] / picture.shape[1])
        self.set_xy(x, y + line.height_mm)

    def write_cards(self, cards: Sequence[Card]) -> None:
        """Draws cards beside each other, on a new page if the current page has too little space."""
        pictures = [None if card.turntable is None else views_of(card.turntable, FINE_PX) for card in cards]
        texts = [[*_lines(self, card)] for card in cards]
        view_mm = TEXT_MM * PANEL_PX[1] / (3 * PANEL_PX[0])
        heights = [
            2 * PAD_MM + (view_mm + 1 if picture is not None else 0) + sum(line.height_mm for line in lines)
            for picture, lines in zip(pictures, texts, strict=True)
        ]
        if self.get_y() + max(heights) > PAGE_MM[1] - MARGIN_MM:
            self.add_page()
        top = self.get_y()
        for column, (card, picture, lines) in enumerate(zip(cards, pictures, texts, strict=True)):
            x = MARGIN_MM + column * (CARD_MM + GAP_MM)
            self.set_fill_color(*CARD)
            self.rect(x, top, CARD_MM, max(heights), style="F")
            self.set_fill_color(*INKS[card_class(card)])
            self.rect(x, top, BAR_MM, max(heights), style="F")
            x += BAR_MM + PAD_MM
            self.set_xy(x, top + PAD_MM)
            if picture is not None:
                self.image(picture, x, top + PAD_MM, w=TEXT_MM, h=view_mm)
                self.set_y(top + PAD_MM + view_mm + 1)
            for line in lines:
                self.write_line(line, x, TEXT_MM)
        self.set_y(top + max(heights) + GAP_MM)


def _lines(pdf: _Page, card: Card) -> Iterator[_Line]:
    printable = latin(card.name) == card.name
    for name in pdf.wrapped(card.name, 10, TEXT_MM)[:2] if printable else [card.name]:
        yield _Line(name, 10, lead=len(name))
    state = "" if card.state == "done" else card.state
    if of := ", ".join(text for text in (card.of, state, card.figures) if text):
        for text in pdf.wrapped(of, 7.5, TEXT_MM)[:2] if latin(of) == of else [of]:
            yield _Line(text, 7.5, FAINT)
    messages = ranked_messages(card)
    for message in messages[:MAX_MESSAGES]:
        code, ink = message["code"], INKS[message_class(card, message)]
        lines = pdf.wrapped(f"{code}  {message['message']}", 8, TEXT_MM)
        if len(lines) > MAX_LINES:
            lines = [*lines[: MAX_LINES - 1], f"{lines[MAX_LINES - 1][:-4]} ..."]
        for number, text in enumerate(lines):
            yield _Line(text, 8, ink if number == 0 else INK, len(code) if number == 0 else 0)
    if len(messages) > MAX_MESSAGES:
        yield _Line(f"and {len(messages) - MAX_MESSAGES} more, in sheet.html", 8, FAINT)


@cache
def _font() -> cv2.FontFace:
    return cv2.FontFace("uni")  # OpenCV's own, with most of the world's letters


def _drawn(text: str, ink: Ink, *, bold: bool) -> tuple[np.ndarray, float]:
    """Returns a line of text as a picture, and the height of a pixel relative to the line's height."""
    size_px, weight = 48, 700 if bold else 400
    printable = "".join(letter if letter.isprintable() else "?" for letter in text)
    _, _, width, _ = cv2.getTextSize((10, 10), printable, (0, 0), _font(), size_px, weight)
    picture = np.full((int(1.5 * size_px), max(width, 1) + 4, 3), CARD[::-1], np.uint8)
    cv2.putText(picture, printable, (0, int(1.1 * size_px)), ink, _font(), size_px, weight)
    return picture, 1 / picture.shape[0]
