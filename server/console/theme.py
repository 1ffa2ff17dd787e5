"""Defines the appearance of all pages: colours and sizes are in ``static/theme.css``, and every page starts with
``page_frame``."""

from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from nicegui import ui
from nicegui.element import Element

from rig.messages.message import Message, documents_of

ACCENT = "#6cb2ff"
PAGES = (
    ("rig", "/", "Rig"),
    ("subjects", "/subjects", "Subjects"),
    ("captures", "/captures", "Captures"),
    ("features", "/features", "Features"),
    ("jobs", "/jobs", "Jobs"),
    ("batches", "/batches", "Batches"),
    ("result", "/result", "Result"),
    ("calibration", "/calibration", "Calibration"),
    ("service", "/service", "Service"),
)

# Before anything is drawn: a page that turns from dark to light while it loads dazzles.
LOOK = (
    'document.documentElement.dataset.look = localStorage.getItem("eigenhead-look") '
    '|| (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark")'
)

# What stands there until the scripts are loaded, at 400 kbit/s for ten seconds; then the style sheet hides it.
STARTING = '<p id="starting" lang="en">eigenhead is loading ... <span lang="de">wird geladen</span></p>'

Answer = Callable[[Any], Awaitable[Any]]


class Frame(Element, component="static/frame.js"):
    """Shows the parts around every page: navigation, status of the service, messages, and the keys that work
    everywhere."""

    def __init__(self, current: str) -> None:
        super().__init__()
        links = [{"name": name, "path": path, "title": title} for name, path, title in PAGES]
        self.props.update(links=links, current=current, status={}, removed=[], followed=[])

    def show(self, **changed: Any) -> None:
        """Updates the frame: the ``status`` of the service, the ``removed`` objects whose removal can be undone, or the
        progress of ``followed`` jobs."""
        if any(self.props[name] != value for name, value in changed.items()):
            self.props.update(changed)
            self.update()

    def say(self, kind: str, message: Message, faults: Iterable[Message] = ()) -> None:
        """Shows a message in the corner, with all ``faults``. ``kind`` is one of "done", "warning" and "fault"."""
        self.run_method("announce", kind, message.document(), documents_of(faults))


def install() -> None:
    """Adds style sheet and colour scheme to the head of every page."""
    ui.add_head_html('<link rel="stylesheet" href="/console/static/theme.css">', shared=True)
    ui.add_head_html('<meta name="color-scheme" content="dark light">', shared=True)
    ui.add_head_html(f"<script>{LOOK}</script>", shared=True)
    ui.add_body_html(STARTING, shared=True)


@contextmanager
def page_frame(current: str) -> Iterator[Frame]:
    """Yields the frame of the page ``current`` and sets the page's title and colours. Elements that the block makes
    appear inside the frame."""
    title = next((title for name, _, title in PAGES if name == current), "Sign in")
    ui.page_title(f"{title} - eigenhead")
    ui.colors(primary=ACCENT, dark="#14171c", dark_page="#0d0f12")
    with Frame(current) as frame:
        yield frame
