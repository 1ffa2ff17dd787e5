"""Draws A4 pages of a PDF with text, tables and pictures, in the standard PDF fonts."""

from collections.abc import Sequence
from datetime import UTC, datetime

import cv2
from fpdf import FPDF

from pipeline.results.overlays import Resized
from rig.formats.pictures.images import encode_image

MARGIN_MM, WIDTH_MM, LINE_MM = 16.0, 178.0, 5.0  # A4 less its margins
INK, FAINT, GOOD, BAD = (30, 30, 30), (110, 110, 110), (20, 110, 60), (178, 24, 43)
JPEG_OPTIONS = (cv2.IMWRITE_JPEG_QUALITY, 92)


class PdfPage(FPDF):
    """Draws A4 pages with a document's margins and fonts; characters outside Latin-1 become question marks. ``date``
    (ISO 8601) is the document's date, which makes the file's bytes reproducible."""

    def __init__(self, title: str, date: str) -> None:
        super().__init__(unit="mm", format="A4")
        self.set_creation_date(datetime.fromisoformat(date).replace(tzinfo=UTC))
        self.set_title(title)
        self.set_margins(MARGIN_MM, MARGIN_MM, MARGIN_MM)
        self.set_auto_page_break(False)

    def line_of(self, text: str, *, size: float = 9, bold: bool = False, ink: tuple[int, int, int] = INK) -> None:
        """Draws a line of text, wrapped if it is too long."""
        self.set_font("Helvetica", style="B" if bold else "", size=size)
        self.set_text_color(*ink)
        self.multi_cell(WIDTH_MM, LINE_MM * size / 9, latin(text), align="L", new_x="LMARGIN", new_y="NEXT")

    def pictures_of(self, row: Sequence[Resized], width_mm: float) -> None:
        """Draws pictures in a row, each ``width_mm`` wide, and moves the cursor below them."""
        top, height = self.get_y(), width_mm * row[0].shape[0] / row[0].shape[1]
        for column, image in enumerate(row):
            self.image(encode_image(".jpg", image, JPEG_OPTIONS), x=MARGIN_MM + column * width_mm, y=top, w=width_mm)
        self.set_y(top + height)

    def scale_of(self, legend: Resized, ends: tuple[str, str]) -> None:
        """Draws a colour scale with words at both ends and 0 in the middle, and moves the cursor below it."""
        left, top, width = MARGIN_MM + 39, self.get_y(), 100
        self.image(encode_image(".jpg", legend, JPEG_OPTIONS), x=left, y=top, w=width, h=4)
        self.set_y(top + 4)
        self.set_font("Helvetica", size=8)
        for share, text in ((0.0, ends[0]), (0.5, "0"), (1.0, ends[1])):
            self.set_x(left + width * share - 20)
            self.cell(40, LINE_MM, text, align="C")
        self.ln(LINE_MM + 1)

    def table_of(
        self, header: Sequence[str], rows: Sequence[Sequence[str]], widths_mm: Sequence[float], inks: dict[int, tuple]
    ) -> None:
        """Draws a table. ``inks`` are the colours of the last cell of each row."""
        for number, row in enumerate([header, *rows], -1):
            self.set_font("Helvetica", style="B" if number < 0 else "", size=8.5)
            for column, (text, width) in enumerate(zip(row, widths_mm, strict=True)):
                last = column == len(row) - 1
                self.set_text_color(*(inks.get(number, INK) if last else INK))
                align = "L" if column == 0 else "R"
                self.cell(width, LINE_MM, latin(text), border="B", align=align)
            self.ln(LINE_MM)
        self.ln(LINE_MM / 2)


def latin(text: str) -> str:
    """Replaces every character outside Latin-1, which the PDF's fonts lack, by a question mark."""
    return text.encode("latin-1", "replace").decode("latin-1")
