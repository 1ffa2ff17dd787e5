"""docs/dependencies.md from uv.lock, docs/dependencies.toml and the installed packages: `make dependencies`."""

import textwrap
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGE, REASONS = ROOT / "docs" / "dependencies.md", ROOT / "docs" / "dependencies.toml"
LICENCE_MOST = 60  # characters; some packages give the whole text
ABSENT = "not installed where this was written"
FILL: Any = {"width": 128, "subsequent_indent": "  ", "break_on_hyphens": False}
HEAD = """# Dependencies

`make dependencies` writes this page from `uv.lock`, `docs/dependencies.toml` and the licences that the installed
packages state.

| package | licence | why |
|---|---|---|
"""
NEEDED = """
## What these need

`uv tree --invert --package NAME` prints what needs a package.

"""


def locked() -> list[dict[str, Any]]:
    """The packages of uv.lock, but for this project."""
    packages = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"]
    return [package for package in packages if package["name"] != "eigenhead"]


def reasons() -> dict[str, str]:
    return tomllib.loads(REASONS.read_text(encoding="utf-8"))


def licence(name: str) -> str:
    """As the installed package states it."""
    try:
        package = metadata(name)
    except PackageNotFoundError:
        return ABSENT
    classified = [c.rpartition(" :: ")[2] for c in package.get_all("Classifier") or [] if c.startswith("License :: ")]
    stated = {field: text for field in ("License-Expression", "License") for text in package.get_all(field) or []}
    licences = [stated.get("License-Expression"), " or ".join(dict.fromkeys(classified)), stated.get("License")]
    return next((" ".join(text.split()) for text in licences if text and len(text) <= LICENCE_MOST), "see its files")


def page() -> str:
    """The packages that we ask for with the reason for each; those that they need by licence."""
    names, why = sorted({package["name"] for package in locked()}), reasons()
    rows = [f"| {name} | {licence(name)} | {why[name]} |\n" for name in names if name in why]
    needed = {name: licence(name) for name in names if name not in why}
    lists = [(stated, [name for name in needed if needed[name] == stated]) for stated in sorted({*needed.values()})]
    fills = (textwrap.fill(f"- {stated}: {', '.join(names)}", **FILL) + "\n" for stated, names in lists)
    return HEAD + "".join(rows) + NEEDED + "".join(fills)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
