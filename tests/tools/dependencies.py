"""docs/dependencies.md from uv.lock, docs/dependencies.toml and the installed packages: `make dependencies`."""

import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGE, REASONS = ROOT / "docs" / "dependencies.md", ROOT / "docs" / "dependencies.toml"
LICENCE_MOST = 60  # characters; some packages give the whole text
ABSENT = "not installed where this was written"
HEAD = """# Dependencies

`make dependencies` writes this page from `uv.lock`, `docs/dependencies.toml` and the licences that the installed
packages state.

| package | licence | why |
|---|---|---|
"""
NEEDED = """
## Packages that these need

By licence; `uv tree --invert --package NAME` says which package needs one.

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
    why, packages = reasons(), sorted({package["name"] for package in locked()})
    rows = [f"| {name} | {licence(name)} | {why[name]} |\n" for name in packages if name in why]
    needed: dict[str, list[str]] = {}
    for name in packages:
        if name not in why:
            needed.setdefault(licence(name), []).append(name)
    lists = [f"- {stated}: {', '.join(names)}\n" for stated, names in sorted(needed.items())]
    return HEAD + "".join(rows) + NEEDED + "".join(lists)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
