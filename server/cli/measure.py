"""Implements ``eigenhead measure``: what helmets, masks and spectacles are fitted by, and the sizes that fit."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from server.cli.answers import Data, Json, answer, warn

if TYPE_CHECKING:
    from pipeline.applications.clinic.sizes import SizeTable

app = typer.Typer(rich_markup_mode=None)


@app.command(epilog="Example: eigenhead measure heads/anna --sizes helmets.toml")
def measure(
    result: Annotated[Path, typer.Argument(help="A result folder.", exists=True, file_okay=False)],
    *,
    sizes: Annotated[
        Path | None, typer.Option(help="Tables of sizes, a TOML file (docs/clinic.md).", exists=True, dir_okay=False)
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="The head model's name or file, if not the one that report.json names.")
    ] = None,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Measure a head for helmets, masks and spectacles.

    Prints each measure with its standard deviation and ISO name, and of every table of sizes how likely each size
    fits."""
    from pipeline.applications.clinic.fitting import ISO_NAMES, MEASURES, Fitted, fitting_measures
    from pipeline.applications.clinic.sizes import choose_size, read_size_tables
    from pipeline.applications.clinic.visit import read_visit
    from rig.messages.message import documents_of

    tables = [] if sizes is None else read_size_tables(sizes)
    visit = read_visit(result, model)
    _check_measures(sizes, tables, {*visit.measurements, *MEASURES})
    measures = {
        name: Fitted(of.value_mm, of.std_mm, "mm") for name, of in visit.measurements.items() if of.std_mm is not None
    }
    measures |= fitting_measures(visit)
    _check_measures(sizes, tables, measures.keys())
    chosen = [choose_size(table, measures[table.measure].value, measures[table.measure].std) for table in tables]
    for warning in visit.warnings:
        warn(str(warning))
    document = {
        "warnings": documents_of(visit.warnings),
        "measures": {
            name: {"value": of.value, "std": of.std, "unit": of.unit, "iso": ISO_NAMES.get(name)}
            for name, of in measures.items()
        },
        "sizes": {
            of.table: {"measure": of.measure, "best": of.best, "probabilities": dict(of.probabilities), "none": of.none}
            for of in chosen
        },
    }
    answer(document, json_out, _lines(document))


def _check_measures(path: Path | None, tables: "Sequence[SizeTable]", known: Collection[str]) -> None:
    """Raises InputError if a table is by a measure that this head does not have."""
    from rig.errors import InputError
    from rig.messages.message import compose

    listed = ", ".join(sorted(known))
    faults = [
        compose("size-measure-unknown", table=of.name, measure=of.measure, known=listed)
        for of in tables
        if of.measure not in known
    ]
    if faults and path is not None:
        raise InputError(path.name, faults)


def _lines(document: Mapping[str, Any]) -> list[str]:
    lines = [
        f"{name:<26} {of['value']:>7.1f} {of['unit']:<3}  (standard deviation {of['std']:.1f})"
        + (f"  {of['iso']}" if of["iso"] else "")
        for name, of in document["measures"].items()
    ]
    for table, of in document["sizes"].items():
        shares = ", ".join(f"{size} {share:.0%}" for size, share in of["probabilities"].items())
        lines.append(f"{table}, by {of['measure']}: {of['best']}  ({shares}, none {of['none']:.0%})")
    return lines
