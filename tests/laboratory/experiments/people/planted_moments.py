"""Counts how often a view of another moment, or of another person, is named, and how often one is named without need.

Heads in the simulated studio, at half size, of which one camera's picture is replaced: by one of the head
``MOVED_MM`` away in a random direction, by one with its jaw open, or by the next subject's. Only the search of the
faces and ``check_one_moment`` run. The camera is a random one of the nine before the head.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.faces.networks import load_networks
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import HeadModel
from pipeline.view_checks.one_moment import check_one_moment
from rig.geometry import Similarity
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject, random_look, random_pose
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.outcome import Outcome, Row

SEED = 491
MOVED_MM = 10.0
MODES, SPREAD = 60, 0.8  # section 5.2
BEFORE_HEAD = 9  # of the default layout's cameras, by number; the other two see profiles
FEWER: Mapping[int, tuple[str, ...]] = {
    5: ("cam00", "cam03", "cam04", "cam07", "cam08"),
    3: ("cam00", "cam05", "cam06"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Planted:
    """Holds one shot, and by kind the picture that takes the place of ``camera``'s."""

    images: Mapping[str, ImageRgb]
    camera: str
    wrong: Mapping[str, ImageRgb]


def planted_moments(model: HeadModel, *, renderer: Renderer, report: Progress, subjects: int = 20) -> Outcome:
    """Runs this module's experiment. Returns, by kind and number of cameras, ``<kind>_<cameras>_named`` (the right
    camera and no other), ``..._noticed`` (any) and ``..._shots``; clean shots have the kind ``clean``.

    Args:
        model: heads are drawn from it.
        renderer: for the studio.
        report: called with the subject and the share done.
        subjects: how many heads.
    """
    rig, networks = default_layout().scaled(0.5), load_networks()
    shots = []
    for number in range(subjects):
        report(f"shot {number}", number / (2 * subjects))
        shots.append(_photograph(model, number, rig, renderer))
    rows: list[Row] = []
    for number, shot in enumerate(shots):
        report(f"check {number}", 0.5 + number / (2 * subjects))
        other = shots[(number + 1) % subjects].images[shot.camera]
        for views in (rig.names, *FEWER.values()):
            part = rig.subset(views)
            wrong = {**shot.wrong, "other": other} if shot.camera in views else {}
            for kind, picture in {"clean": shot.images[shot.camera], **wrong}.items():
                images = {name: shot.images[name] for name in views} | (
                    {} if kind == "clean" else {shot.camera: picture}
                )
                check = check_one_moment(find_subject(images, part, networks), images, part)
                named = [view.camera for view in check.odd]
                rows.append(
                    {
                        "subject": number,
                        "kind": kind,
                        "cameras": len(views),
                        "noticed": bool(named),
                        "named": check.certain and named == [shot.camera],
                        "offset_mm": round(max((view.offset_mm for view in check.odd), default=0.0), 1),
                    }
                )
    figures = _figures(rows)
    return {"figures": figures, "rows": rows, "markdown": markdown.of_figures(figures)}


def _figures(rows: Sequence[Row]) -> dict[str, float]:
    figures: dict[str, float] = {}
    for row in rows:
        key = f"{row['kind']}_{row['cameras']}"
        for name, count in (("named", row["named"]), ("noticed", row["noticed"]), ("shots", 1)):
            figures[f"{key}_{name}"] = figures.get(f"{key}_{name}", 0) + int(count)
    return figures


def _photograph(model: HeadModel, number: int, rig: Rig, renderer: Renderer) -> Planted:
    rng = np.random.default_rng((SEED, number))
    coefficients, look = SPREAD * rng.standard_normal(MODES), random_look(rng)
    pose = random_pose(np.zeros(3), PRESET.pose_spread_deg, PRESET.pose_spread_mm, rng)
    camera = rig.names[rng.integers(BEFORE_HEAD)]
    step = rng.standard_normal(3)
    moved = Similarity(1.0, pose.rotation, pose.translation + MOVED_MM * step / np.linalg.norm(step))

    def shoot(
        weights: Mapping[str, float], world_from_head: Similarity, cameras: Sequence[str]
    ) -> Mapping[str, ImageRgb]:
        vertices, full = model.posed_vertices(coefficients, weights), model.levels["full"]
        marks = {name: vertices[row] for name, row in model.landmarks.items()}
        subject = Subject(Mesh(vertices, full.faces), marks, full.face_region, f"seed-{number}")
        return simulate(
            subject, rig.subset(cameras), replace(PRESET, plates=1), np.random.default_rng((SEED, number, 1)),
            renderer=renderer, look=look, world_from_head=world_from_head,
        ).capture.images  # fmt: skip

    wrong = {"moved": shoot({}, moved, [camera])[camera], "jaw": shoot({"jawOpen": 1.0}, pose, [camera])[camera]}
    return Planted(shoot({}, pose, rig.names), camera, wrong)
