"""Tells the size of a helmet, mask or frame for a head: each size's probability, by the measure's deviation.

A table is a TOML file:

    format = "eigenhead-sizes/1"

    [[table]]
    name = "helmet"
    measure = "head_circumference"
    allowance = 6.0                     # added to the measure: padding, hair; 0 without it
    sizes = { S = [520, 550], M = [550, 580], L = [580, 610] }

Limits are in the measure's unit (mm, or degrees), the lower one inclusive.
"""

import tomllib
from collections.abc import Mapping, Set
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from scipy.special import ndtr

from rig.errors import InputError
from rig.messages.message import Message, compose

FORMAT = "eigenhead-sizes/1"
KEYS = frozenset({"name", "measure", "sizes", "allowance"})
MIN_STD = 1e-6


@dataclass(frozen=True, slots=True)
class SizeTable:
    """Holds the limits of each size of a product, in the unit of its measure."""

    name: str
    measure: str
    sizes: Mapping[str, tuple[float, float]]
    allowance: float = 0.0


@dataclass(frozen=True, slots=True)
class SizeChoice:
    """Holds the probability of each size of a table. ``best`` is the likeliest; ``none`` the probability that no size
    fits."""

    table: str
    measure: str
    probabilities: Mapping[str, float]
    none: float

    @property
    def best(self) -> str:
        """Returns the likeliest size."""
        return max(self.probabilities, key=lambda size: self.probabilities[size])


def read_size_tables(path: Path, measures: Set[str]) -> list[SizeTable]:
    """Reads a file of tables by these measures. Raises InputError naming every fault."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(path.name, [compose("sizes-unread", reason=str(error))]) from error
    entries = document.get("table")
    if document.get("format") != FORMAT or not isinstance(entries, list) or not entries:
        raise InputError(path.name, [compose("sizes-no-table", format=FORMAT)])
    faults = [fault for number, entry in enumerate(entries, 1) for fault in _faults(number, entry)] or [
        compose(
            "size-measure-unknown", table=entry["name"], measure=entry["measure"], known=", ".join(sorted(measures))
        )
        for entry in entries
        if entry["measure"] not in measures
    ]
    if faults:
        raise InputError(path.name, faults)
    return [
        SizeTable(
            entry["name"],
            entry["measure"],
            {size: (float(low), float(high)) for size, (low, high) in entry["sizes"].items()},
            float(entry.get("allowance", 0.0)),
        )
        for entry in entries
    ]


def choose_size(table: SizeTable, value: float, std: float) -> SizeChoice:
    """Returns how likely each size of a table fits a measure with a normal error."""
    wanted, spread = value + table.allowance, max(std, MIN_STD)
    found = {
        size: float(ndtr((high - wanted) / spread) - ndtr((low - wanted) / spread))
        for size, (low, high) in table.sizes.items()
    }
    return SizeChoice(table.name, table.measure, found, max(1.0 - sum(found.values()), 0.0))


def _faults(number: int, entry: Any) -> list[Message]:
    """Returns what is wrong with a table of the file."""
    if not isinstance(entry, dict):
        return [compose("size-key-wrong", number=number, key="table")]
    wrong = [key for key in ("name", "measure") if not isinstance(entry.get(key), str) or not entry[key]]
    wrong += sorted(entry.keys() - KEYS)
    if not _is_number(entry.get("allowance", 0.0)):
        wrong.append("allowance")
    sizes = entry.get("sizes")
    if not isinstance(sizes, dict) or not sizes:
        return [compose("size-key-wrong", number=number, key=key) for key in [*wrong, "sizes"]]
    bad = [
        size
        for size, limits in sizes.items()
        if not isinstance(limits, list)
        or len(limits) != 2
        or not all(_is_number(limit) for limit in limits)
        or not limits[0] < limits[1]
    ]
    faults = [compose("size-key-wrong", number=number, key=key) for key in wrong]
    faults += [compose("size-limits-wrong", number=number, size=size) for size in bad]
    if not bad:
        ordered = sorted(sizes.items(), key=lambda of: of[1][0])
        faults += [
            compose("sizes-overlap", number=number, size=one, other=other)
            for (one, limits), (other, after) in pairwise(ordered)
            if after[0] < limits[1]
        ]
    return faults


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9
