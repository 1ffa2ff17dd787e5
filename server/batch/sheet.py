"""Draws the contact sheet of a batch: one self-contained HTML file (``server.batch.sheet_pdf``: as a PDF).

The sheet shows of each head three views, its name, figures and warnings. Red marks warnings that question the head
itself, amber those about missing input, grey the rest. The sheet contains no times, so equal results give equal bytes.
"""

import base64
import html
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np

from pipeline.results.overlays import AZIMUTHS_DEG
from rig.formats.pictures.images import encode_image
from rig.messages.message import MessageDocument

SEVERE = frozenset(
    {
        "camera-moved", "cameras-exchanged", "contour-implausible", "face-elsewhere", "mask-contradicted",
        "masks-exchanged", "masks-off-edges",
        "outlines-unexplained", "plates-exchanged", "pose-doubtful", "scale-implausible",
        "size-unusual",
    }
)  # fmt: skip
"""Codes of warnings after which the head may be wrong as a whole; docs/operator.md says of each what to do."""
REMARKS = frozenset(
    {"cameras-scaled", "file-unread", "masks-of-alpha", "old-setting", "picture-levels", "setting-renamed"}
    | {"unknown-key", "views-many"}
)
"""Codes of what was only told."""
PANEL_PX = (112, 144)  # of a view on the sheet
JPEG_QUALITY = 82
STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d232a; --faint: #66707a; --card: #f4f5f6; --line: #d8dce0;
  --severe: #b3261e; --warning: #8a5a00; --good: #1f6f43; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181c; --ink: #e6e9ec; --faint: #9aa4ad; --card: #1e242a;
  --line: #323a42; --severe: #ff8a80; --warning: #f0b64d; --good: #7fd1a0; } }
body { margin: 1.5rem; background: var(--paper); color: var(--ink); font: 14px/1.4 system-ui, sans-serif; }
h1 { font-size: 1.3rem; margin: 0 0 .2rem; } p { margin: 0 0 1rem; color: var(--faint); }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(336px, 1fr)); gap: 12px; }
article { background: var(--card); border: 1px solid var(--line); border-left: 5px solid var(--good);
  border-radius: 6px; padding: 8px 10px; overflow-wrap: anywhere; }
article.severe, article.failed { border-left-color: var(--severe); }
article.warning { border-left-color: var(--warning); }
article.missing { border-left-color: var(--line); }
img { display: block; width: 100%; height: auto; border-radius: 4px; background: #f5f5f5; }
h2 { font-size: 1rem; margin: 6px 0 0; } h2 a { color: inherit; } .of { color: var(--faint); margin: 0; }
ul { margin: 4px 0 0; padding-left: 1.1em; font-size: 13px; } code { font-size: 12px; }
.severe > code, .failed li { color: var(--severe); font-weight: 600; }
.warning > code { color: var(--warning); font-weight: 600; }
.remark > code { color: var(--faint); }
@media print { main { display: block; columns: 2; } article { break-inside: avoid; margin-bottom: 12px; } }
"""


@dataclass(frozen=True, slots=True)
class Card:
    """Holds what the sheet shows of one capture. ``of``: subject and session; ``messages``: the capture's warnings, or
    why the capture failed; ``turntable``: the picture with its views; ``link``: the result's address from the sheet."""

    name: str
    of: str
    state: str
    figures: str
    messages: tuple[MessageDocument, ...]
    turntable: Path | None
    link: str


def severity(code: str) -> str:
    """Returns how serious a warning with this code is: ``severe``, ``warning`` or ``remark``."""
    return "severe" if code in SEVERE else "remark" if code in REMARKS else "warning"


def card_class(card: Card) -> str:
    """Returns the CSS class for a card's colour: its worst warning's, or the state's of an unfinished capture."""
    if card.state != "done":
        return card.state
    severities = {severity(message["code"]) for message in card.messages}
    return next((kind for kind in ("severe", "warning") if kind in severities), "good")


def ranked_cards(cards: Iterable[Card]) -> list[Card]:
    """Returns the cards in the order of the sheet: the most serious first, then by name."""
    order = ("failed", "severe", "warning", "good", "missing")
    return sorted(cards, key=lambda card: (order.index(card_class(card)), card.name))


def ranked_messages(card: Card) -> list[MessageDocument]:
    """Returns the messages of a card, the most serious first."""
    ranks = ("severe", "warning", "remark")
    return sorted(card.messages, key=lambda message: ranks.index(severity(message["code"])))


def message_class(card: Card, message: MessageDocument) -> str:
    """Returns the CSS class for the colour of a message on a card."""
    return "failed" if card.state == "failed" else severity(message["code"])


def sheet_lines(title: str, cards: Sequence[Card]) -> Iterator[str]:
    """Yields the sheet as parts of HTML, so that memory need not hold the pictures of a thousand heads. Captures that
    need attention come first."""
    yield '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>"
    yield f"<h1>{html.escape(title)}</h1><p>{html.escape(summary(cards))}</p><main>"
    for card in ranked_cards(cards):
        yield "\n".join([f'<article class="{card_class(card)}">', *_content(card), "</article>"])
    yield "</main></body></html>\n"


def summary(cards: Iterable[Card]) -> str:
    """Returns the first line of the sheet: how many captures are good, have warnings, failed or are missing."""
    words = {
        "good": "without a warning that matters", "warning": "with warnings", "severe": "that may be wrong",
        "failed": "failed", "missing": "not made yet",
    }  # fmt: skip
    counts = Counter(card_class(card) for card in cards)
    counted = [f"{counts[kind]} {word}" for kind, word in words.items() if counts[kind]]
    return f"{sum(counts.values())} captures: {', '.join(counted)}"


def views_of(turntable: Path, panel_px: tuple[int, int] = PANEL_PX) -> bytes | None:
    """Returns right profile, front and left profile from a result's turntable.png as one JPEG file. ``panel_px``: width
    and height of a view. Returns None if the picture cannot be read."""
    drawn = cv2.imread(str(turntable), cv2.IMREAD_COLOR)
    if drawn is None:
        return None
    panels = np.array_split(drawn, len(AZIMUTHS_DEG), axis=1)
    chosen = (panels[0], panels[len(panels) // 2], panels[-1])
    small = np.hstack([cv2.resize(panel, panel_px, interpolation=cv2.INTER_AREA) for panel in chosen])
    return encode_image(".jpg", small[:, :, ::-1], (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))


def figures_of(row: Mapping[str, object]) -> str:
    """Returns the most requested figures of a head as one line: breadth, length and deviation (mm). ``row`` is the
    head's row of the table."""
    names = {"head_breadth_mm": "breadth", "head_length_mm": "length", "quality_median_mm": "deviation"}
    cells = [(word, row.get(name)) for name, word in names.items()]
    return ", ".join(f"{word} {value:.1f} mm" for word, value in cells if isinstance(value, float))


def _content(card: Card) -> Iterator[str]:
    picture = None if card.turntable is None else views_of(card.turntable)
    if picture is not None:
        data = base64.b64encode(picture).decode()
        alt = html.escape(f"{card.name}: right, front and left", quote=True)
        width, height = 3 * PANEL_PX[0], PANEL_PX[1]
        yield f'<img width="{width}" height="{height}" alt="{alt}" src="data:image/jpeg;base64,{data}">'
    name = html.escape(card.name)
    shown = f'<a href="{quote(card.link)}">{name}</a>' if card.state == "done" else name
    yield f"<h2>{shown}</h2>"
    state = "" if card.state == "done" else card.state
    line = ", ".join(text for text in (card.of, state, card.figures) if text)
    if line:
        yield f'<div class="of">{html.escape(line)}</div>'
    if card.messages:
        yield "<ul>"
        for message in ranked_messages(card):
            kind = message_class(card, message)
            code, text = html.escape(message["code"]), html.escape(message["message"])
            yield f'<li class="{kind}"><code>{code}</code> {text}</li>'
        yield "</ul>"
