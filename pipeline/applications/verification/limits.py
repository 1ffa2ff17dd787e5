"""Holds what a studio must reach: limits, each of which a user may set, and checks of figures against them.

The default limits are about one and a half times what the simulated studio reaches with a bare mannequin of another
population than the model's (tests/laboratory/notes/verification.md), so that a sound rig passes and one with a
lasting fault does not.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from rig.typed_tables import read_table


@dataclass(frozen=True, slots=True)
class Limits:
    """Holds the limit of each figure of a verification: the largest value allowed, except for ``least_covered``, which
    is the smallest."""

    face_rms_mm: float = 0.35  # deviation from the reference, of any capture
    features_rms_mm: float = 0.8  # the same of eyes, nose and mouth, the worst of them
    probing_form_mm: float = 4.5  # range of the deviations of 99.7 % of the face
    size_error_percent: float = 0.3
    distance_mm: float = 5.0  # RMS of the landmark distances: what nothing fixes along the surface slides
    repeatability_mm: float = 0.2  # scatter over the face along its normal, RMS
    least_covered: float = 0.9  # share of the face that the reference covers


@dataclass(frozen=True, slots=True)
class Check:
    """Holds a figure beside its limit. ``value`` and ``passed`` are None if the captures or the reference do not
    provide the figure."""

    name: str
    value: float | None
    limit: float
    passed: bool | None  # None: not judged


def limits_from_document(document: Mapping[str, Any], subject: str = "limits") -> Limits:
    """Returns the limits from decoded JSON or TOML. Raises InputError that names every unknown key and wrong value."""
    return read_table(Limits, document, subject)


def checks(limits: Limits, values: Mapping[str, float | None]) -> tuple[Check, ...]:
    """Returns a check for every limit; ``values`` are the figures by the limits' names."""
    found = []
    for field in fields(limits):
        limit, value = getattr(limits, field.name), values[field.name]
        passed = None if value is None else value >= limit if field.name.startswith("least") else value <= limit
        found.append(Check(field.name, value, limit, passed))
    return tuple(found)
