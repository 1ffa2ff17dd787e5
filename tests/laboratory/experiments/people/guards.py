"""Counts false alarms and hits of every guard (``pipeline.view_checks.guards``) over captures at hand.

Each capture goes through reading, masks and the checks of its views, as ``eigenhead check`` does; no head is fitted, so
that guards after the fit have none. Captures in a folder called ``faulty`` should not pass in silence, all others
should. The studio adds good captures, and the same with a rig in another unit. Good ones are
judged again with one camera 10 mm aside. A guard's false alarms are its messages
on good captures, its hits those on faulty ones.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.scene.rig_scale import times
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.segmentation.segment import segment
from pipeline.view_checks.guards import GUARDS, Guard, Guards
from pipeline.view_checks.lens_distortion import judge_distortion
from pipeline.view_checks.one_moment import judge_moments
from pipeline.view_checks.usable_views import usable_views
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.geometry import RigidTransform
from rig.messages.message import Message
from rig.render.renderer import Renderer
from rig.rig import Rig
from server.tasks.photographs import read_scaled_capture
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.people.gazes import photograph_gaze
from tests.laboratory.experiments.records import Bench, Outcome, Row

STUDIO_HEADS = 2
WRONG_SCALES = (0.3, 3.0)  # of the studio's rig
FAULTY = "faulty"


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Holds the codes that the checks gave for one capture, nested ones too, and whether nothing is wrong with it."""

    source: str
    good: bool
    codes: frozenset[str]


def guards(
    folders: Sequence[Path], *, model: HeadModel, renderer: Renderer, bench: Bench, subjects: int = STUDIO_HEADS
) -> Outcome:
    """Judges the captures ``folders`` and those of the studio. Returns a row for each guard and source of captures, and
    the figures ``false_alarms``, ``good``, ``hits`` and ``faulty``: captures on which any guard that refuses spoke."""
    judged = []
    for number, path in enumerate(folders):
        bench.report(path.name, number / (len(folders) + subjects))
        good = FAULTY not in path.resolve().parts
        capture, rig = read_scaled_capture(path)
        judged.append(judge(path.resolve().parent.name, good, capture, rig))
        judged += [judge("another moment", False, capture, move_one(rig, number))] if good else []
    for number in range(subjects):
        bench.report("studio", (len(folders) + number) / (len(folders) + subjects))
        shot = photograph_gaze(model, number, renderer)
        judged.append(judge("studio", True, shot.capture, shot.rig))
        judged.append(judge("another moment", False, shot.capture, move_one(shot.rig, number)))
        judged += [judge("studio", False, shot.capture, times(shot.rig, factor)) for factor in WRONG_SCALES]
    rows = [row for guard in GUARDS for row in rows_of(guard, judged)]
    refusing = {code for guard in GUARDS if guard.kind != "warns" for code in guard.codes}
    figures = {}
    for good, alarm, count in ((True, "false_alarms", "good"), (False, "hits", "faulty")):
        those = [one for one in judged if one.good is good]
        figures |= {alarm: float(sum(not one.codes.isdisjoint(refusing) for one in those)), count: float(len(those))}
    header = ("guard", "kind", "captures", "false_alarms", "good", "hits", "faulty", "evidence", "prevents")
    return {
        "figures": figures,
        "rows": rows,
        "markdown": markdown.table(header, [[row[name] for name in header] for row in rows]),
        "lines": [
            f"{row['guard']} ({row['captures']}): {row['false_alarms']} false alarms in {row['good']} good captures, "
            f"{row['hits']} hits in {row['faulty']} faulty ones"
            for row in rows
            if row["false_alarms"] or row["hits"]
        ],
    }


def judge(source: str, good: bool, capture: Capture, rig: Rig) -> Judged:
    """Runs the checks before a fit. A refusal counts with its warnings' codes, as it would with ``anyway``."""

    def segmented(shot: Capture) -> dict[str, Silhouette]:
        return segment(shot, rig, report=lambda stage, share: None)

    try:
        views = usable_views(capture, rig, segmented, exchanged="repair", guards=Guards(anyway=True))
    except EigenheadError as refusal:
        return Judged(source, good, frozenset(codes_of(refusal.message)))
    lenses = judge_distortion(views.capture.images, views.silhouettes, rig)
    warnings = (*views.warnings, *lenses, *judge_moments(find_subject(views.capture.images, rig, load_networks()), rig))
    return Judged(source, good, frozenset(code for said in warnings for code in codes_of(said)))


def move_one(rig: Rig, number: int) -> Rig:
    """Returns the rig for which one camera's picture shows the subject 10 mm aside, as of another moment."""
    moved, aside = rig.cameras[number % len(rig)], RigidTransform(np.eye(3), np.array([10.0, 0.0, 0.0]))
    return Rig(tuple(replace(c, camera_from_world=aside @ c.camera_from_world) if c is moved else c for c in rig))


def codes_of(message: Message) -> set[str]:
    """Returns the code of a message and of the messages within it."""
    codes = {message.code}
    for value in message.parameters.values():
        for part in value if isinstance(value, list | tuple) else (value,):
            if isinstance(part, Message):
                codes |= codes_of(part)
    return codes


def rows_of(guard: Guard, judged: Iterable[Judged]) -> list[Row]:
    """Returns a guard's false alarms and hits, a row for each source of captures."""
    total, raised = Counter[tuple[str, bool]](), Counter[tuple[str, bool]]()
    for one in judged:
        total[one.source, one.good] += 1
        raised[one.source, one.good] += not one.codes.isdisjoint(guard.codes)
    return [
        {
            "guard": guard.codes[0],
            "kind": guard.kind,
            "evidence": "; ".join(guard.evidence),
            "prevents": guard.prevents,
            "captures": source,
            "false_alarms": raised[source, True],
            "good": total[source, True],
            "hits": raised[source, False],
            "faulty": total[source, False],
        }
        for source in sorted({source for source, _ in total})
    ]
