"""Tables of figures in the documents: `make results` writes them from what is kept, `make results TABLE=captures` runs
that table's command first.

docs/results/<table>.json keeps what a command printed: the command, the day, the machine and the figures by name.
docs/results/<table>.txt, and <table>.<part>.txt for another document, are the words around them, with `{figure:.2f}`
where a figure stands, and `{command:}`, `{date:}`, `{machine:}`; figures in plain digits were taken by hand. A document
shows one between `<!-- table: captures -->` and `<!-- end of table -->`.
"""

import datetime
import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from rig.atomic_write import write_atomically

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "docs" / "results"
NOTES = ROOT / "tests" / "laboratory" / "notes"
DOCUMENTS = (ROOT / "docs" / "results.md", *sorted(NOTES.glob("*.md")), ROOT / "README.md")
TABLE = re.compile(r"(<!-- table: ([\w.-]+) -->\n\n)(.*?)(\n*<!-- end of table -->)", re.DOTALL)
PLACE = re.compile(r"\{([\w.-]+):([^{}]*)\}")
HOURS_MOST = 12


class UnknownTable(Exception):
    """A table for which nothing is kept."""

    def __init__(self, name: str) -> None:
        super().__init__(f"no table is called {name!r}; there are {', '.join(names())}")


def names() -> list[str]:
    return sorted(path.stem for path in KEPT.glob("*.json"))


def kept(name: str) -> dict[str, Any]:
    """`command`, `date`, `machine`, `figures`. Raises UnknownTable."""
    if name not in names():
        raise UnknownTable(name)
    return json.loads((KEPT / f"{name}.json").read_text(encoding="utf-8"))


def written(name: str) -> str:
    """The table called ``name`` (of the file of words) with its figures. Raises KeyError where one is not kept."""
    document = kept(name.partition(".")[0])
    figures = document["figures"] | {key: document[key] for key in ("command", "date", "machine")}
    words = (KEPT / f"{name}.txt").read_text(encoding="utf-8").strip()
    return PLACE.sub(lambda place: format(figures[place[1]], place[2]), words)


def with_tables(text: str) -> str:
    """A document's text with every table as it is kept."""
    return TABLE.sub(lambda found: found[1] + written(found[2]) + "\n\n" + found[4].lstrip("\n"), text)


def take(name: str) -> None:
    """Runs the table's command, which prints one JSON object that has `figures`, and keeps them."""
    command = kept(name)["command"]
    program, *arguments = command.split()
    run = [str(Path(sys.executable).with_name(program)), *arguments]
    done = subprocess.run(run, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=HOURS_MOST * 3600, check=True)
    document = {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{len(os.sched_getaffinity(0))} cores of {platform.machine()}",
        "figures": json.loads(done.stdout)["figures"],
    }
    write_atomically(KEPT / f"{name}.json", (json.dumps(document, indent=1) + "\n").encode())


def main(tables: list[str]) -> None:
    for name in tables:
        take(name)
    for document in DOCUMENTS:
        write_atomically(document, with_tables(document.read_text(encoding="utf-8")).encode())


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UnknownTable as error:
        sys.exit(str(error))
