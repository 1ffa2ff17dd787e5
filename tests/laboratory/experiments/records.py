"""Defines the result of an experiment, and keeps the rows of long ones as they are computed, so that a stopped run can
continue."""

import hashlib
import inspect
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, NotRequired, TypedDict

import numpy as np

from pipeline.contour_fit import (
    clutter,
    contour,
    head_problem,
    noise_model,
    prior_term,
    problem,
    rim,
    rim_kernels,
    rim_term,
)
from pipeline.estimation import levenberg_marquardt, terms
from pipeline.geometry import projection_kernels
from pipeline.imaging import sampling_kernels
from rig.files import write_atomically
from rig.progress import Progress, discard_progress

# What rows of the contour solver depend on, for keys.
CONTOUR = (
    *(levenberg_marquardt, terms, contour, problem, head_problem, rim_term, prior_term),
    *(clutter, noise_model, rim, rim_kernels, projection_kernels, sampling_kernels),
)


Row = dict[str, Any]  # of one subject: each experiment has its own quantities


class Outcome(TypedDict):
    """Holds the result of an experiment.

    ``figures`` is flat and has every number that README and docs quote. ``markdown`` and ``pictures`` go to files; the
    rest is printed, with ``lines`` instead of the figures for people.
    """

    figures: dict[str, float]
    rows: list[Row] | dict[str, list[Row]]
    markdown: NotRequired[str]
    lines: NotRequired[list[str]]
    pictures: NotRequired[dict[str, np.ndarray]]
    machine: NotRequired[str]
    planned_directions_deg: NotRequired[list[tuple[int, int]]]
    wrong: NotRequired[list[int]]


class Records:
    """Holds rows by key in one JSON file; without a folder, in memory alone."""

    def __init__(self, folder: Path | None, name: str, key: str, report: Progress = discard_progress) -> None:
        """``key`` names all that the rows depend on (model, settings, code version): another key starts anew."""
        self._path = None if folder is None else folder / f"{name}.json"
        self._key, self._report = key, report
        self._rows: dict[str, Row] = {}
        if self._path is not None and self._path.is_file():
            kept = json.loads(self._path.read_text())
            self._rows = kept["rows"] if kept.get("key") == key else {}

    def row(self, name: str, compute: Callable[[], Row], begun: float | None = None) -> Row:
        """Returns the row of this name; if there is none it is computed and kept. ``begun``: the share of the
        experiment before this row, which is reported."""
        if begun is not None:
            self._report(name, begun)
        if name not in self._rows:
            self._rows[name] = compute()
            if self._path is not None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(self._path, json.dumps({"key": self._key, "rows": self._rows}).encode())
        return self._rows[name]


def key_of(*parts: object) -> str:
    """Returns a key for ``Records``. Modules enter by their source, so that rows of older code are computed anew, and
    everything else by its text."""
    texts = [inspect.getsource(part) if isinstance(part, ModuleType) else str(part) for part in parts]
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Bench:
    """Holds what experiments report their progress to, and the folder that keeps their rows (None: nothing is kept)."""

    report: Progress = discard_progress
    folder: Path | None = None

    def records(self, name: str, key: str) -> Records:
        """Returns the kept rows of this name, see ``Records``."""
        return Records(self.folder, name, key, self.report)


def means_by(rows: Sequence[Row], group: str) -> dict[str, float]:
    """Returns the mean of every figure over the rows of each ``group`` that have it."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if isinstance(value, float):
                values.setdefault(f"{row[group]}_{key}", []).append(value)
    return {key: float(np.mean(found)) for key, found in values.items()}
