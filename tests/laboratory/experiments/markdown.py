"""Formats tables as Markdown."""

from collections.abc import Mapping, Sequence

Cell = str | float | int | None


def table(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Returns a Markdown table; numbers with three significant digits, None as a dash."""
    lines = [header, ["---"] * len(header), *([_text(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def of_figures(figures: Mapping[str, float]) -> str:
    """Returns a Markdown table with a row for each figure: its name and its value."""
    return table(("figure", "value"), list(figures.items()))


def _text(cell: Cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:.0f}" if float(cell).is_integer() or abs(cell) >= 1000 else f"{cell:.3g}"
