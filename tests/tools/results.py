"""Tables of figures in the documents: `make results` writes them from what is kept, `make results TABLE=captures` runs
that table's command first.

docs/results/<table>.json keeps what a command printed: the command, the day, the machine and the figures by name.
docs/results/<table>.txt, and <table>.<part>.txt for another document, are the words around them, with `{figure:.2f}`
where a figure stands, and `{command:}`, `{date:}`, `{machine:}`; figures in plain digits were taken by hand. A document
shows one between `<!-- table: captures -->` and `<!-- end of table -->`. docs/pictures/uncertainty.svg is
drawn of the figures that the experiment `hidden` printed.
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

from rig.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "docs" / "results"
NOTES = ROOT / "tests" / "laboratory" / "notes"
DOCUMENTS = (
    ROOT / "docs" / "results.md",
    ROOT / "docs" / "uncertainty.md",
    *sorted(NOTES.glob("*.md")),
    ROOT / "README.md",
)
TABLE = re.compile(r"(<!-- table: ([\w.-]+) -->\n\n)(.*?)(\n*<!-- end of table -->)", re.DOTALL)
PLACE = re.compile(r"\{([\w.-]+):([^{}]*)\}")
HOURS_MOST = 12
UNCERTAINTY = ROOT / "docs" / "pictures" / "uncertainty.svg"
POPULATIONS = {"studio": "heads of the model's population", "draws": "heads of another population"}
REGIONS = ("face", "eyes", "nose", "mouth", "ears", "neck", "cranium")
MEDIAN_OF_NORMAL = 0.6745  # of |x| / sigma for a normal x
PX_A_MM, PX_A_ROW = 90.0, 22


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


def uncertainty_svg(figures: dict[str, float]) -> str:
    """Draws the median error of each region: as sigma predicts it (circle), and as it was measured (dot)."""
    rows: list[str] = []
    for population, title in POPULATIONS.items():
        rows.append(f'<text x="8" y="{PX_A_ROW * (len(rows) + 1.7)}" font-weight="bold">{title}</text>')
        for kind, region in ((kind, region) for kind in ("seen", "hidden") for region in REGIONS):
            key = f"{population}_fine_{kind}_{region}"
            if f"{key}_stated_mm" in figures:
                y = PX_A_ROW * (len(rows) + 1.7)
                predicted, measured = MEDIAN_OF_NORMAL * figures[f"{key}_stated_mm"], figures[f"{key}_median_mm"]
                one, other = (130.0 + PX_A_MM * value**0.5 for value in (predicted, measured))
                rows.append(
                    f'<g><text x="8" y="{y}">{region}, {kind}</text>'
                    f'<path d="M{one:.1f} {y - 4}H{other:.1f}" stroke="grey"/>'
                    f'<circle cx="{one:.1f}" cy="{y - 4}" r="5" fill="none" stroke="grey" stroke-width="2"/>'
                    f'<circle cx="{other:.1f}" cy="{y - 4}" r="4" fill="#c60"/>'
                    f'<text x="430" y="{y}">{predicted:.2f} / {measured:.2f} mm</text></g>'
                )
    head = '<text x="8" y="16">median error: predicted by sigma (circle) / measured (dot), mm; square-root scale</text>'
    size = f'width="560" height="{PX_A_ROW * (len(rows) + 2)}" font-family="sans-serif" font-size="13" fill="#888"'
    return "\n".join([f'<svg xmlns="http://www.w3.org/2000/svg" {size}>', head, *rows, "</svg>", ""])


def write_uncertainty() -> None:
    write_atomically(UNCERTAINTY, uncertainty_svg(kept("hidden")["figures"]).encode())


def main(tables: list[str]) -> None:
    for name in tables:
        take(name)
    for document in DOCUMENTS:
        write_atomically(document, with_tables(document.read_text(encoding="utf-8")).encode())
    write_uncertainty()


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UnknownTable as error:
        sys.exit(str(error))
