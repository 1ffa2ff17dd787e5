"""The documents as a site: every link leads somewhere, and no page asks for anything from elsewhere."""

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[1]
LOADED = re.compile(r"<(?:script|img|iframe|source)\b[^>]*?\ssrc=\"?([^\s\">]+)|<link\b[^>]*?\shref=\"?([^\s\">]+)")
LINKED = re.compile(r"<a\b[^>]*?\shref=\"?([^\s\">]+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="deploy/setup.sh --docs installs it")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-P", "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def targets(pattern: re.Pattern[str], page: Path) -> set[str]:
    found = pattern.findall(page.read_text(encoding="utf-8"))
    return {next(filter(None, groups), "") if isinstance(groups, tuple) else groups for groups in found}


def test_every_document_is_a_page(site: Path) -> None:
    docs = ROOT / "docs"
    pages = {path.relative_to(docs).with_suffix(".html") for path in docs.rglob("*.md")}
    assert pages < {page.relative_to(site) for page in site.rglob("*.html")}
    assert "Two commands" in (site / "index.html").read_text(encoding="utf-8")


def test_every_link_within_the_site_leads_to_a_file_and_a_place(site: Path) -> None:
    seen = 0
    for page in site.rglob("*.html"):
        for link in targets(LINKED, page):
            if link.startswith(("http://", "https://", "mailto:", "javascript:")) or page.name == "404.html":
                continue
            file, _, anchor = unquote(link).partition("#")
            target = (page.parent / file).resolve() if file and file != "." else page
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), (page.name, link)
            assert not anchor or re.search(rf"\b(?:id|name)=\"?{re.escape(anchor)}[\s\">]", target.read_text()), link
            seen += 1
    assert seen > 300


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert [place for place in targets(LOADED, page) if re.match(r"(?:https?:)?//", place)] == [], page.name


def test_every_heading_is_one(site: Path) -> None:
    """A fence that the site's Markdown does not know swallows all up to the next one."""
    for page in sorted((ROOT / "docs").glob("*.md")):
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        shown = (site / page.relative_to(ROOT / "docs").with_suffix(".html")).read_text(encoding="utf-8")
        wanted, found = len(re.findall(r"^##+ ", text, re.MULTILINE)), len(re.findall(r"<h[2-6]\b[^>]*\bid=", shown))
        assert found == wanted, page.name
