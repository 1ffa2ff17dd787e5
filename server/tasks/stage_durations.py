"""How long each stage of a reconstruction takes on this machine: learnt from every job, by what the job makes.

The service's workers and the command line learn into one file, ``cache_folder()/durations.json``. The first job of a
kind goes by ``FIRST_S``.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pipeline.settings import Settings
from rig.atomic_write import write_atomically
from rig.cache_folder import cache_folder

FIRST_S = {
    "read": 1.0,
    "segmentation": 1.2,
    "alignment": 0.6,
    "fit": 0.8,
    "parts": 1.5,
    "fit again": 2.7,
    "depth": 4.0,
    "fine": 3.0,
    "texture": 1.0,
    "bust": 3.0,
    "atlas": 3.0,
    "evidence": 0.5,
    "write": 1.5,
}
"""Seconds of every stage, in their order, two cores."""
SIMPLEX_S = 60.0  # of the simplex's fit
LEARNING = 0.3  # weight of the newest job
LONGEST_S = 86_400.0  # what a damaged file may at most say of a stage

PHOTO_DETAIL = (None, "photo", "fine")


def kind_of(settings: Settings) -> str:
    """What decides which stages a job has and how long they are: "contour photo both", say."""
    atlas = " atlas" if settings.outputs.atlas else ""
    return f"{settings.method} {settings.detail or 'photo'} {settings.outputs.surface}{atlas}"


def first_guess(settings: Settings) -> dict[str, float]:
    """Seconds of the stages that a job with these settings has, before one was seen."""
    photographs = settings.method == "contour" and settings.detail in PHOTO_DETAIL
    fine, bust = photographs and settings.detail == "fine", settings.outputs.surface != "head"
    parts = settings.detail in PHOTO_DETAIL or bust
    left_out = {
        "parts": not parts,
        "fit again": not parts,
        "depth": not (fine or bust),
        "fine": not fine,
        "bust": not bust,
        "atlas": not settings.outputs.atlas,
    }
    seconds = {stage: took for stage, took in FIRST_S.items() if not left_out.get(stage)}
    if settings.method == "simplex":
        seconds["fit"] = SIMPLEX_S
    if parts and not photographs:
        seconds["fit again"] = 0.0
    return seconds


class StageDurations:
    """Seconds that each stage is expected to take. ``file`` need not exist; where it cannot be written, only this
    process learns."""

    def __init__(self, file: Path | None = None) -> None:
        self._file = file or cache_folder() / "durations.json"
        self._learnt: dict[str, dict[str, float]] = {}

    def of(self, settings: Settings) -> dict[str, float]:
        """Seconds by stage, in their order."""
        known = self._read().get(kind_of(settings), {})
        return {stage: known.get(stage, seconds) for stage, seconds in first_guess(settings).items()}

    def learn(self, settings: Settings, seconds: Mapping[str, float]) -> None:
        """Takes in how long the stages of a job took."""
        learnt, before = self._read(), self.of(settings)
        mixed = {
            stage: (1 - LEARNING) * before[stage] + LEARNING * seconds[stage] for stage in before if stage in seconds
        }
        learnt[kind_of(settings)] = {stage: round(took, 3) for stage, took in (before | mixed).items()}
        self._learnt = learnt
        with suppress(OSError):
            write_atomically(self._file, json.dumps(learnt, indent=1).encode())

    def _read(self) -> dict[str, dict[str, float]]:
        """What the file says, and where there is none, what this process has learnt."""
        try:
            document = json.loads(self._file.read_bytes())
            return {
                str(kind): {stage: float(stages[stage]) for stage in FIRST_S if 0 <= stages.get(stage, -1) <= LONGEST_S}
                for kind, stages in document.items()
            }
        except (OSError, ValueError, TypeError, AttributeError):
            return dict(self._learnt)
