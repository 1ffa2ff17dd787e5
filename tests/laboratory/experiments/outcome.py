"""Defines the result of an experiment."""

from typing import Any, NotRequired, TypedDict

import numpy as np

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
