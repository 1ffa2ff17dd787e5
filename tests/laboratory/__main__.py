"""Implements ``python -m tests.laboratory NAME``: repeats the paper's experiments, runs those of this project, and its
benchmarks. Needs a checkout: a wheel does not carry the laboratory."""

import os
import sys

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as in server.cli.main

import typer

from rig.errors import EigenheadError
from server.cli.answers import answer, fail
from tests.laboratory.runner import lines_of, run
from tests.laboratory.table import BENCHMARKS, EXPERIMENTS

USAGE = "python -m tests.laboratory NAME [FOLDERS...] [options] [--json]"


def describe() -> str:
    """Returns the list of names with their sentences, and an example."""
    lines = [f"Usage: {USAGE}", "       python -m tests.laboratory NAME --help"]
    for title, records in (("Experiments", EXPERIMENTS), ("Benchmarks", BENCHMARKS)):
        lines += ["", f"{title}:", *(f"  {name:<22} {record.sentence}" for name, record in records.items())]
    return "\n".join([*lines, "", "Example: python -m tests.laboratory limit --subjects 3 --json"])


def main(words: list[str]) -> None:
    """Runs the command line. The exit status is 0 if it succeeded, 1 if it failed, 2 for wrong usage."""
    if not words or words[0] in ("-h", "--help"):
        print(describe())
        return
    name, *rest = words
    records = EXPERIMENTS | BENCHMARKS
    if name not in records:
        print(f"no experiment or benchmark is called {name!r}; there are {', '.join(records)}", file=sys.stderr)
        sys.exit(2)
    try:
        found, as_json = run(name, records[name], rest)
    except typer.BadParameter as error:
        print(f"{USAGE}: {error.format_message()}", file=sys.stderr)
        sys.exit(2)
    except EigenheadError as error:
        fail(str(error))
    lines = lines_of(found)
    found.pop("lines", None)
    answer(found, as_json, lines)


if __name__ == "__main__":
    main(sys.argv[1:])
