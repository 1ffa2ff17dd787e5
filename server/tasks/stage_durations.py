"""Learns how long each stage of a reconstruction takes on this machine, for each kind of job.

The service's workers and the command line share one file, ``cache_folder()/durations.json``. ``FIRST_S`` is expected
before the first job of a kind.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pipeline.settings import FINE_LEVELS, PHOTO_LEVELS, Settings
from rig.atomic_write import write_atomically
from rig.cache_folder import cache_folder

FIRST_S = {
    "read": 0.4,
    "segmentation": 4.3,
    "faces": 2.0,
    "alignment": 0.6,
    "fit": 3.7,
    "parts": 2.1,
    "fit again": 7.1,
    "depth": 40.0,
    "fine": 9.0,
    "texture": 1.4,
    "evidence": 0.8,
    "bust": 6.0,
    "write": 3.0,
}
"""Seconds of every stage, in their order: `eigenhead reconstruct scan-a --detail fine` on two cores that four
other processes share; of the bust what is waited for after the head. On idle ones all are three to four times
shorter, which a job's own pace soon tells."""
SIMPLEX_S = 200.0  # of the simplex's fit, at the same pace: a minute on idle cores
LEARNING = 0.3  # weight of the newest job; the first one of its kind counts alone
LONGEST_S = 86_400.0  # what a damaged file may at most say of a stage


def kind_of(settings: Settings) -> str:
    """Returns the kind of a job as text such as "contour photo both": the settings that decide which stages it has and
    how long they take."""
    return f"{settings.method} {settings.detail or 'fine'} {settings.outputs.surface}"


def first_guess(settings: Settings) -> dict[str, float]:
    """Returns the seconds expected of each stage of a job with these settings before any job was measured."""
    photographs = settings.method == "contour" and settings.detail in PHOTO_LEVELS
    fine, bust = photographs and settings.detail in FINE_LEVELS, settings.outputs.surface != "head"
    parts = settings.detail in PHOTO_LEVELS or bust
    left_out = {
        "parts": not parts,
        "fit again": not parts,
        "depth": not (fine or bust),
        "fine": not fine,
        "bust": not bust,
    }
    seconds = {stage: took for stage, took in FIRST_S.items() if not left_out.get(stage)}
    if settings.method == "simplex":
        seconds["fit"] = SIMPLEX_S
    if parts and not photographs:
        seconds["fit again"] = 0.0
    return seconds


def pace_of(learnt: Mapping[str, Mapping[str, float]]) -> float:
    """Returns how many times slower this machine is than ``FIRST_S``, from the measured stages of each kind of job; 1
    if nothing was measured."""
    took = guessed = 0.0
    for kind, stages in learnt.items():
        simplex = kind.startswith("simplex")
        known = {stage: seconds for stage, seconds in stages.items() if seconds > 0}
        took += sum(known.values())
        guessed += sum(SIMPLEX_S if simplex and stage == "fit" else FIRST_S[stage] for stage in known)
    return took / guessed if took > 0 and guessed > 0 else 1.0


class StageDurations:
    """Learns how many seconds each stage of a job takes, and keeps them in ``file``. If the file cannot be written,
    they are known to this process only."""

    def __init__(self, file: Path | None = None) -> None:
        self._file = file or cache_folder() / "durations.json"
        self._learnt: dict[str, dict[str, float]] = {}

    def of(self, settings: Settings) -> dict[str, float]:
        """Returns the expected seconds of each stage, in order. For a kind of job that this machine never ran, they are
        the first guess scaled by the pace of other kinds."""
        learnt, guess = self._read(), first_guess(settings)
        known = learnt.get(kind_of(settings))
        if known is None:
            known, pace = {}, pace_of(learnt)
            guess = {stage: pace * seconds for stage, seconds in guess.items()}
        return {stage: known.get(stage, seconds) for stage, seconds in guess.items()}

    def learn(self, settings: Settings, seconds: Mapping[str, float]) -> None:
        """Mixes the measured seconds of a job's stages into what is expected of its kind, with the weight
        ``LEARNING``."""
        learnt, before = self._read(), self.of(settings)
        weight = LEARNING if kind_of(settings) in learnt else 1.0
        mixed = {stage: (1 - weight) * before[stage] + weight * seconds[stage] for stage in before if stage in seconds}
        learnt[kind_of(settings)] = {stage: round(took, 3) for stage, took in (before | mixed).items()}
        self._learnt = learnt
        with suppress(OSError):
            write_atomically(self._file, json.dumps(learnt, indent=1).encode())

    def _read(self) -> dict[str, dict[str, float]]:
        """Returns the durations of the file or, without one, those that this process has measured."""
        try:
            document = json.loads(self._file.read_bytes())
            return {
                str(kind): {stage: float(stages[stage]) for stage in FIRST_S if 0 <= stages.get(stage, -1) <= LONGEST_S}
                for kind, stages in document.items()
            }
        except (OSError, ValueError, TypeError, AttributeError):
            return dict(self._learnt)
