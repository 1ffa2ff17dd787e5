"""Learns how long each stage of a reconstruction takes on this machine, for each kind of job.

A job's seconds are first computed from its products and the pixels of its photographs (``COSTS_S``); the learnt values
are the factors by which each stage takes longer on this machine. The service's workers and the command line share one
file, ``cache_folder()/stage-paces.json``.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from statistics import median

from pipeline.settings import FINE_LEVELS, PHOTO_LEVELS, Settings
from rig.errors import InputError
from rig.files import cache_folder, write_atomically
from rig.formats.captures.capture_folder import capture_root
from rig.formats.captures.shot_files import listed_pictures, picture_folder
from rig.formats.pictures.images import picture_size
from rig.formats.pictures.work_size import WORK_PIXELS

COSTS_S: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "read": {"head": (1.1, 0.03)},
    "segmentation": {"head": (0.3, 0.4)},
    "faces": {"head": (1.2, 0.3)},
    "alignment": {"head": (0.15, 0.0)},
    "fit": {"head": (0.8, 0.03)},
    "parts": {"parts": (0.2, 0.06)},
    "fit again": {"head": (0.1, 0.0), "photo": (3.2, 0.05)},
    "depth": {"depth": (0.4, 1.0)},
    "fine": {"head": (0.6, 0.0), "fine": (5.5, 0.0), "bust": (0.0, 0.6)},
    "texture": {"head": (0.8, 0.09), "bust": (1.0, 0.06)},
    "evidence": {"head": (0.1, 0.04), "bust": (2.0, 0.17)},
    "bust": {"bust": (0.4, 0.2)},
    "write": {"head": (0.7, 0.04), "bust": (0.1, 0.02), "morphs": (15.0, 0.0)},
}
"""Of every stage, in order, what each part of a job adds: CPU seconds, and CPU seconds a megapixel, as jobs of 3, 11
and 24 photographs took them on one core (`python -m tests.laboratory remaining-time`)."""
SIMPLEX_S = 60.0  # of the simplex's fit, on one idle core
USUAL_MEGAPIXELS = 8.65  # eleven photographs of 1024 x 768: where a capture's own are not known
LEARNING = 0.3  # weight of a job's stage, beside what was learnt or else the pace of the whole job
PACE_MOST = 1000.0  # what a damaged file may at most say of a stage


def kind_of(settings: Settings) -> str:
    """Returns the kind of a job as text such as "contour photo both": the settings that determine its stages and their
    durations."""
    words = [settings.method, settings.detail or "fine", settings.outputs.surface]
    words += ["morphs"] * settings.outputs.morphs + ["template"] * bool(settings.outputs.template)
    return " ".join(words)


def megapixels_of(capture: Path) -> float:
    """Returns the megapixels that a job reads of each photograph, by the capture's first one; ``USUAL_MEGAPIXELS`` for
    an archive and for unreadable files."""
    with suppress(InputError, OSError):
        if pictures := listed_pictures(picture_folder(capture_root(capture))):
            width, height = picture_size(pictures[0])
            return len(pictures) * min(width * height, WORK_PIXELS) / 1e6
    return USUAL_MEGAPIXELS


def first_guess(settings: Settings, megapixels: float = USUAL_MEGAPIXELS) -> dict[str, float]:
    """Returns the seconds expected of each stage of a job with these settings before any job was measured."""
    photo = settings.method == "contour" and settings.detail in PHOTO_LEVELS
    fine, bust = photo and settings.detail in FINE_LEVELS, settings.outputs.surface != "head"
    has = {"head": True, "photo": photo, "fine": fine, "bust": bust, "parts": photo or bust, "depth": fine or bust}
    has["morphs"] = settings.outputs.morphs
    costs = {stage: [cost for part, cost in of.items() if has[part]] for stage, of in COSTS_S.items()}
    seconds = {stage: sum(fixed + each * megapixels for fixed, each in of) for stage, of in costs.items() if of}
    return seconds | {"fit": SIMPLEX_S} if settings.method == "simplex" else seconds


class StageDurations:
    """Learns how much longer than the first guess each stage takes, as a factor, and stores the factors in ``file``. If
    the file cannot be written, the values last as long as this process."""

    def __init__(self, file: Path | None = None) -> None:
        self._file = file or cache_folder() / "stage-paces.json"
        self._learnt: dict[str, dict[str, float]] = {}

    def of(self, settings: Settings, megapixels: float = USUAL_MEGAPIXELS) -> dict[str, float]:
        """Returns the expected seconds of each stage, in order. For a new kind of job the seconds are the first guess,
        scaled by the pace of other kinds."""
        learnt, guess = self._read(), first_guess(settings, megapixels)
        known, every = learnt.get(kind_of(settings), {}), [pace for of in learnt.values() for pace in of.values()]
        usual = median(every) if every else 1.0
        return {stage: known.get(stage, usual) * seconds for stage, seconds in guess.items()}

    def learn(self, settings: Settings, seconds: Mapping[str, float], megapixels: float = USUAL_MEGAPIXELS) -> None:
        """Mixes the measured seconds of a job's stages into the expected values of its kind, with the weight
        ``LEARNING``."""
        learnt, guess = self._read(), first_guess(settings, megapixels)
        before, stages = learnt.get(kind_of(settings), {}), guess.keys() & seconds.keys()
        whole = sum(seconds[stage] for stage in stages) / max(sum(guess[stage] for stage in stages), 1e-9)
        for stage, pace in ((stage, seconds[stage] / guess[stage]) for stage in stages):
            before[stage] = round((1 - LEARNING) * before.get(stage, whole) + LEARNING * pace, 4)
        self._learnt = learnt | {kind_of(settings): before}
        with suppress(OSError):
            write_atomically(self._file, json.dumps(self._learnt, indent=1).encode())

    def _read(self) -> dict[str, dict[str, float]]:
        """Returns the paces of the file or, without one, those that this process has measured."""
        try:
            document = json.loads(self._file.read_bytes())
            return {
                str(kind): {stage: float(stages[stage]) for stage in COSTS_S if 0 <= stages.get(stage, -1) <= PACE_MOST}
                for kind, stages in document.items()
            }
        except (OSError, ValueError, TypeError, AttributeError):
            return dict(self._learnt)
