"""Counts false alarms and hits of every guard (``pipeline.view_checks.guards``) over captures at hand.

Each capture goes through reading, masks and the checks of its views, as ``eigenhead check`` does; guards after the fit
speak only with ``fitted``, which makes a head of each. Captures in a folder called ``faulty`` should not pass in
silence, all others should, and draws of 3 to 11 of their cameras. The studio adds the heads of ``people`` before rows
and fans of cameras, at rest and with open mouths, and each with a rig in another unit. In every good capture faults are
planted in one camera that shows the face: another moment (the rig has moved by 10 to 20 mm, in any direction), another
person's picture, a mask cut at the crown, and a picture with an open jaw. A guard's false alarms are its messages on
good captures, its hits those on faulty ones; of each planted fault, ``named`` counts the codes of ``NAMED_BY``.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.scene.scale import times
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import HeadModel
from pipeline.segmentation.segment import segment
from pipeline.settings import OutputSettings, Settings
from pipeline.texturing import vertex_colours
from pipeline.view_checks import head_size, one_moment, usable_views
from pipeline.view_checks.guards import FaceEvidence, Guards, find_face_evidence
from pipeline.view_checks.lens_distortion import judge_distortion
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.geometry import RigidTransform
from rig.messages.message import Message
from rig.progress import discard_progress
from rig.render.renderer import Renderer
from rig.rig import Rig
from server.tasks.photographs import read_scaled_capture
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.people.people import run_job
from tests.laboratory.experiments.people.people_subjects import SEED, STUDIO_KINDS, StudioKind, photograph
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of

KINDS = [kind for kind in STUDIO_KINDS if kind.kind.startswith("front")]
OPEN_JAW = {"jawOpen": 1.0}
COUNTS = (3, 5, 8, 11)  # of cameras in a draw, of which so many show the face if so many do:
FACES_DRAWN = 3
MOVED_MM = (10.0, 20.0)
CUT_SHARE = 0.12  # of a mask's height, from its crown
WRONG_SCALES = (0.3, 3.0)  # of the studio's rig
FAULTY = "faulty"
REFUSING = (  # codes of each guard that refuses a capture
    ("size-refused",), ("too-few-views",), ("pictures-exchanged",), ("pictures-the-same",), ("outlines-unexplained",),
    ("other-rig", "other-lenses", "other-convention", "principal-points-from-below", "rig-mirrored",
     "pictures-flipped", "pictures-turned"), ("no-subject",),
    ("features-beside-face", "features-of-size", "features-from-bottom", "features-transposed",
     "features-of-other-pictures", "features-of-no-landmark", "features-sides-exchanged", "too-few-features",
     "too-few-features-remarks"),
)  # fmt: skip
WARNING = ("camera-moved", "view-left-out", "mask-contradicted", "crown-low", "moments-differ", "view-unlike",
           "lens-doubtful", "mask-loose", "scale-implausible", "outlines-loose")  # fmt: skip
NAMED_BY = {
    "another moment": {"moments-differ", "view-unlike"},
    "open jaw": {"moments-differ", "view-unlike"},
    "another person": {"moments-differ", "view-unlike", "view-left-out"},
    "cut crown": {"crown-low"},
}


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Holds a capture with its masks, and its face if two views agree on one."""

    capture: Capture
    rig: Rig
    masks: Mapping[str, Bool[np.ndarray, "_ _"]]
    face: FaceEvidence | None

    def draw(self, rng: np.random.Generator) -> "Shot":
        """Returns some of the cameras."""
        faces = [] if self.face is None else rng.permutation(self.face.views)[:FACES_DRAWN].tolist()
        rest = [name for name in rng.permutation(self.rig.names).tolist() if name not in faces]
        names = (faces + rest)[: min(rng.choice(COUNTS), len(self.rig))]
        of: Any = {kind: {n: v for n, v in getattr(self.capture, kind).items() if n in names} for kind in PICTURES}
        capture, rig = Capture(**of), self.rig.subset([name for name in self.rig.names if name in names])
        return Shot(capture, rig, {n: self.masks[n] for n in names}, find_face_evidence(capture.images, rig))


PICTURES = ("images", "backgrounds", "masks")
Judge = Callable[[str, bool, Capture, Rig], Row]
FITTED = replace(Settings(), detail="photo", anyway=True, outputs=OutputSettings(surface="head"))


def guards(
    folders: Sequence[Path],
    *,
    model: HeadModel,
    renderer: Renderer,
    bench: Bench,
    subjects: Annotated[int, "heads in the studio"] = len(KINDS),
    draws: Annotated[int, "of cameras, for each folder"] = 3,
    fitted: Annotated[bool, "make a head of each capture, at level photo"] = False,
) -> Outcome:
    """Judges the captures ``folders`` and those of the studio. Returns a row for each guard and source of captures, and
    the figures ``false_alarms``, ``good``, ``hits`` and ``faulty``: captures on which any guard that refuses spoke;
    ``<fault>_named`` and ``<fault>_planted``."""
    judge = partial(judge_fitted, model, renderer) if fitted else judge_views
    name = "guards-fitted" if fitted else "guards"
    records = bench.records(name, key_of(model.sha256, draws, one_moment, head_size, usable_views, vertex_colours))
    jobs = {path.name: partial(judge_folder, path, _other(path, folders), draws, judge) for path in folders}
    studio = partial(judge_studio, model, renderer, judge)
    jobs |= {f"studio {n} {KINDS[n % len(KINDS)].what}": partial(studio, n) for n in range(subjects)}
    judged: list[Row] = []
    for number, (name, job) in enumerate(jobs.items()):
        judged += records.row(name, lambda job=job: {"judged": list(job())}, number / len(jobs))["judged"]
    rows = [row for codes in (*REFUSING, *((code,) for code in WARNING)) for row in rows_of(codes, judged)]
    refusing = {code for codes in REFUSING for code in codes}
    figures = {}
    for good, alarm, count in ((True, "false_alarms", "good"), (False, "hits", "faulty")):
        those = [one for one in judged if one["good"] is good]
        figures |= {alarm: float(sum(not refusing.isdisjoint(one["codes"]) for one in those)), count: float(len(those))}
    for fault, codes in NAMED_BY.items():
        those = [one for one in judged if one["source"] == fault]
        named = sum(not codes.isdisjoint(one["codes"]) for one in those)
        figures |= {f"{fault}_named": float(named), f"{fault}_planted": float(len(those))}
    header = ("guard", "captures", "false_alarms", "good", "hits", "faulty")
    text = markdown.table(header, [[row[name] for name in header] for row in rows])
    lines = [*text.splitlines(), *map(str, figures.items())]
    return {"figures": figures, "rows": rows, "markdown": text, "lines": lines}


def _other(path: Path, folders: Sequence[Path]) -> Path | None:
    """Returns the folder of another person: none whose name begins alike."""
    return next(
        (one for one in folders if not one.name.startswith(path.name) and not path.name.startswith(one.name)), None
    )


def judge_folder(path: Path, other: Path | None, draws: int, judge: Judge) -> Iterator[Row]:
    """Judges a folder's capture, draws of its cameras, and all of these with planted faults."""
    capture, rig = read_scaled_capture(path)
    source = path.resolve().parent.name
    if FAULTY in path.resolve().parts:
        yield judge(source, False, capture, rig)
        return
    rng = np.random.default_rng([SEED, *path.name.encode()])
    whole, stranger = make_shot(capture, rig), None if other is None else make_shot(*read_scaled_capture(other))
    for shot in (whole, *(whole.draw(rng) for _ in range(draws))):
        yield judge(source, True, shot.capture, shot.rig)
        yield from judge_planted(shot, rng, stranger, judge)


def judge_studio(model: HeadModel, renderer: Renderer, judge: Judge, number: int) -> Iterator[Row]:
    """Judges a head of the studio at rest and with an open mouth, and planted faults."""
    kind = KINDS[number % len(KINDS)]

    def make(kind: StudioKind) -> Shot:
        made = photograph(kind, model, True, renderer, (SEED, number))
        return make_shot(made.capture, made.rig)

    shot, opened = make(kind), make(replace(kind, expression=OPEN_JAW))
    rng = np.random.default_rng((SEED, number))
    for one in (shot, opened):
        yield judge("studio", True, one.capture, one.rig)
    yield judge("studio", False, shot.capture, times(shot.rig, WRONG_SCALES[number % 2]))
    yield from judge_planted(shot, rng, None, judge)
    if shot.face is not None and not kind.expression:
        yield judge("open jaw", False, exchange_one(shot, str(rng.choice(shot.face.views)), opened), shot.rig)


def make_shot(capture: Capture, rig: Rig) -> Shot:
    """Returns a capture with its masks and its face."""
    masks = {name: found.mask for name, found in segment(capture, rig, report=discard_progress).items()}
    return Shot(capture, rig, masks, find_face_evidence(capture.images, rig))


def judge_planted(shot: Shot, rng: np.random.Generator, stranger: Shot | None, judge: Judge) -> Iterator[Row]:
    """Plants faults in one camera that shows the face, and judges the captures."""
    if shot.face is None:
        return
    name = str(rng.choice(shot.face.views))
    yield judge("another moment", False, shot.capture, move_one(shot.rig, name, rng))
    if stranger is not None:
        yield judge("another person", False, exchange_one(shot, name, stranger), shot.rig)
    if (cut := cut_crown(shot, name)) is not None:
        yield judge("cut crown", False, cut, shot.rig)


def move_one(rig: Rig, name: str, rng: np.random.Generator) -> Rig:
    """Returns the rig for which one camera's picture shows the subject elsewhere, as of another moment."""
    way = rng.standard_normal(3)
    aside = RigidTransform(np.eye(3), rng.uniform(*MOVED_MM) * way / np.linalg.norm(way))
    return Rig(tuple(replace(c, camera_from_world=aside @ c.camera_from_world) if c.name == name else c for c in rig))


def exchange_one(shot: Shot, name: str, stranger: Shot) -> Capture:
    """Returns the capture in which one camera has the picture and the mask that ``stranger`` has under the same name,
    or under its first one that shows a face; scaled to the size of this one's."""
    there = name if name in stranger.rig.names else (stranger.face.views if stranger.face else stranger.rig.names)[0]
    size = shot.capture.images[name].shape[1::-1]
    picture = cv2.resize(stranger.capture.images[there], size, interpolation=cv2.INTER_AREA)
    mask = cv2.resize(stranger.masks[there].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return Capture({**shot.capture.images, name: picture}, masks={**shot.masks, name: mask})


def cut_crown(shot: Shot, name: str) -> Capture | None:
    """Returns the capture with one mask that lacks the crown; None if the crown is not in the picture."""
    assert shot.face is not None
    middle: Float[np.ndarray, "2 2"] = shot.rig[name].project(
        shot.face.centre_world + np.outer((0, 50.0), shot.face.up_world)
    )
    rows, columns = np.nonzero(shot.masks[name])
    high = np.stack([columns, rows], axis=1) @ (middle[1] - middle[0])
    top = int(np.argmax(high))
    limit = np.array(shot.masks[name].shape) - 3
    if not 2 < rows[top] < limit[0] or not 2 < columns[top] < limit[1]:
        return None
    kept, cut = high < high.max() - CUT_SHARE * np.ptp(high), np.zeros_like(shot.masks[name])
    cut[rows[kept], columns[kept]] = True
    return Capture(shot.capture.images, masks={**shot.masks, name: cut})


def judge_fitted(model: HeadModel, renderer: Renderer, source: str, good: bool, capture: Capture, rig: Rig) -> Row:
    """Makes a head, as ``--anyway`` does. Returns the codes that were told, nested ones too."""
    try:
        warnings = run_job(capture, rig, model, FITTED, renderer).warnings
    except EigenheadError as refusal:
        warnings = (refusal.message,)
    return {"source": source, "good": good, "codes": sorted({code for said in warnings for code in codes_of(said)})}


def judge_views(source: str, good: bool, capture: Capture, rig: Rig) -> Row:
    """Runs the checks before a fit. Returns the codes that they gave, nested ones too. A refusal counts with its
    warnings' codes, as it would with ``anyway``."""
    segmented = partial(segment, rig=rig, report=discard_progress)
    row: Row = {"source": source, "good": good}
    try:
        views = usable_views.usable_views(capture, rig, segmented, exchanged="repair", guards=Guards(anyway=True))
    except EigenheadError as refusal:
        return row | {"codes": sorted(codes_of(refusal.message))}
    lenses = judge_distortion(views.capture.images, views.silhouettes, rig)
    moments = one_moment.judge_moments(find_subject(views.capture.images, rig, load_networks()), rig)
    return row | {"codes": sorted({code for said in (*views.warnings, *lenses, *moments) for code in codes_of(said)})}


def codes_of(message: Message) -> set[str]:
    """Returns the code of a message and of the messages within it."""
    codes = {message.code}
    for value in message.parameters.values():
        for part in value if isinstance(value, list | tuple) else (value,):
            if isinstance(part, Message):
                codes |= codes_of(part)
    return codes


def rows_of(codes: Sequence[str], judged: Iterable[Row]) -> list[Row]:
    """Returns a guard's false alarms and hits, a row for each source of captures."""
    total, raised = Counter[tuple[str, bool]](), Counter[tuple[str, bool]]()
    for one in judged:
        key = one["source"], one["good"]
        total[key] += 1
        raised[key] += any(code in codes for code in one["codes"])
    return [
        {
            "guard": codes[0],
            "captures": source,
            "false_alarms": raised[source, True],
            "good": total[source, True],
            "hits": raised[source, False],
            "faulty": total[source, False],
        }
        for source in sorted({source for source, _ in total})
    ]
