"""MkDocs hook: the pages at the top of the checkout stand on the site beside those of docs/, README.md as the first,
and links between the two lead there. The laboratory's notes are no part of the site: a link to them is its text."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "SECURITY.md": "SECURITY.md",
}
_FROM_TOP = re.compile(r"""(?:(?<=\]\()|(?<=src="))docs/""")
_TO_NOTES = re.compile(r"\[([^\]]*)\]\(tests/laboratory/[^)]*\)")
_TO_TOP = re.compile(r"(?<=\]\()((?:\.\./)+)(\w+\.md)")


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Adds the pages at the top of the repository to the site, with their links into docs/ adapted."""
    for name, place in PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, place, content=_TO_NOTES.sub(r"\1", _FROM_TOP.sub("", text))))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """A page of docs/ reaches the top by one step up for each of its folders and one out of docs/; on the site the
    latter falls away."""
    steps = 3 * (page.file.src_uri.count("/") + 1)  # "../" has three letters

    def lead(link: re.Match[str]) -> str:
        reaches = len(link[1]) == steps and link[2] in PAGES
        return link[1][3:] + PAGES[link[2]] if reaches else link[0]

    return _TO_TOP.sub(lead, markdown)
