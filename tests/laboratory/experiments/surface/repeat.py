"""Measures repeatability: one studio subject, with the same skin, hair and set each time, shot ten times.

- ``noise``: it holds still; only sensor noise and light drift differ;
- ``reposed``: it sits down anew, and lamps are moved and dimmed;
- ``drift``: the same with cameras that have moved from their calibration, farther with each shot;
- ``clicked``: as ``noise``, with feature points that an operator clicks anew in each shot; the others have none.

Each shot is reconstructed from its photographs; the heads are laid on each other rigidly over the face
(``verification.repeatability``). Figures are the scatter, the deviation that the results state, and the error that
every shot repeats: the distance of the mean head from the true surface. The aim is an RMS scatter of at most 0.10
mm over the face, ``reposed_rms_mm`` and ``drift_rms_mm``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from pipeline import reconstruct as composition
from pipeline.applications.verification import judgement
from pipeline.applications.verification.judgement import scatter
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import vertex_areas
from pipeline.reconstruct import reconstruct
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.capture import Capture
from rig.geometry import rigid_fit
from rig.mesh import Mesh
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.lights import LAMPS, Lamp
from rig.studio.scene.simulate import Scene, build_scene, shoot
from rig.studio.scene.subject import Subject, random_look, random_pose
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import off_by

SHOTS = 10
SEED = 17
DRIFT_PX = 0.05  # a shot, of each camera; after ten shots 0.16, near the 0.2 px that an unstated rig is trusted to
LAMP_SHIFT = 0.15  # of ``Lamp.towards``: some 8 degrees
LAMP_DIMMING = 0.1  # standard deviation of log brightness, of each lamp by itself
CONDITIONS = ("noise", "reposed", "drift", "clicked")
STILL = ("noise", "clicked")


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Holds a reconstructed head (world frame), the deviations that it states (mm, along the normal), and the truth."""

    vertices: Float[np.ndarray, "v 3"]
    stated_mm: Float[np.ndarray, " v"]
    truth: Mesh  # world frame
    photographed: Bool[np.ndarray, " v"]  # of the truth: seen by a camera, not under hair
    warnings: frozenset[str]  # codes


def repeat(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = SHOTS) -> Outcome:
    """Runs this module's experiment. Returns scatter, stated deviation and repeated error by condition. ``subjects`` is
    the number of shots, two or more."""
    records = bench.records("repeat", key_of(model.sha256, Settings(), subjects, *CONTOUR, composition, judgement))
    rows = []
    for i, condition in enumerate(CONDITIONS):
        report_shots = partial(_of_condition, bench.report, condition, i)
        compute = partial(_row, model, condition, max(2, subjects), renderer, report_shots)
        rows.append({"condition": condition} | records.row(condition, compute))
    figures = {f"{row['condition']}_{name}": row[name] for row in rows for name in row if name != "condition"}
    columns = ("rms_mm", "median_mm", "seen_rms_mm", "normal_rms_mm", "stated_mm", "stated_median_mm", "repeated_mm")
    header = (
        "shots differ by",
        "RMS, mm",
        "median",
        "seen skin",
        "along the normal",
        "stated",
        "median",
        "repeated error",
    )
    table = [[row["condition"], *(row[column] for column in columns)] for row in rows]
    return {"figures": figures, "rows": rows, "markdown": markdown.table(header, table)}


def _of_condition(report: Progress, condition: str, number: int, shot: str, fraction: float) -> None:
    report(f"{condition} {shot}", (number + fraction) / len(CONDITIONS))


def _row(model: HeadModel, condition: str, count: int, renderer: Renderer, report: Progress) -> Row:
    shots = []
    for i, (scene, rng) in enumerate(scenes(model, condition, count, renderer)):
        report(f"shot {i + 1}", i / count)
        capture = shoot(scene, rng)
        capture = capture if condition == "clicked" else replace(capture, features={})
        shots.append(reconstructed(scene, capture, model, renderer))
    return judged(model, shots)


def scenes(
    model: HeadModel, condition: str, count: int, renderer: Renderer
) -> Iterator[tuple[Scene, np.random.Generator]]:
    """Yields the scene of each shot with the rig as calibrated, and a random generator for the shot's own noise. If
    cameras drift, the calibration is moved instead of the cameras, which a shot cannot distinguish."""
    rng = np.random.default_rng(SEED)
    full, head = model.levels["full"], model.vertices(rng.standard_normal(len(model.modes)))
    marks = {name: head[row] for name, row in model.landmarks.items()}
    subject = Subject(Mesh(head, full.faces), marks, full.face_region, f"drawn from {model.name}")
    look, rig = random_look(rng), default_layout()
    calibrated, kept = rig, None
    for i in range(count):
        light_rng, pose_rng, drift_rng, shot_rng = np.random.default_rng([SEED, i]).spawn(4)
        if kept is None or condition not in STILL:
            pose = random_pose(rig.centre_world(), PRESET.pose_spread_deg, PRESET.pose_spread_mm, pose_rng)
            scene_rng, lamps = np.random.default_rng(SEED), moved(light_rng)
            kept = build_scene(
                subject, rig, PRESET, scene_rng, renderer=renderer, look=look, world_from_head=pose, lamps=lamps
            )
        calibrated = off_by(calibrated, DRIFT_PX, drift_rng) if condition == "drift" else rig
        yield replace(kept, rig=calibrated), shot_rng


def moved(rng: np.random.Generator) -> tuple[Lamp, ...]:
    """Returns the studio's lamps, each moved and dimmed at random."""
    lamps = []
    for lamp in LAMPS:
        x, y, z = (np.array(lamp.towards) + rng.normal(0, LAMP_SHIFT, 3)).tolist()
        red, green, blue = (np.array(lamp.colour) * np.exp(rng.normal(0, LAMP_DIMMING))).tolist()
        lamps.append(replace(lamp, towards=(x, y, z), colour=(red, green, blue)))
    return tuple(lamps)


def reconstructed(scene: Scene, capture: Capture, model: HeadModel, renderer: Renderer) -> Shot:
    """Reconstructs a simulated capture, and returns the head with its stated deviations, the truth, and the
    warnings."""
    settings = Settings(outputs=OutputSettings(surface="head"))
    done = reconstruct(ReconstructionContext(capture, scene.rig, model, settings, renderer))
    codes = frozenset(warning.code for warning in done.warnings)
    return Shot(done.mesh_world.vertices, done.refined.deviation_mm, scene.head, scene.photographed, codes)


def judged(model: HeadModel, shots: list[Shot]) -> Row:
    """Returns figures over the face, over the part of its skin that cameras see in every shot (``seen_``), and of the
    error that all shots repeat."""
    full = model.levels["full"]
    face, areas = full.face_region, vertex_areas(shots[0].vertices, full.faces)
    seen = face & np.all([shot.photographed for shot in shots], axis=0)
    found = scatter(np.stack([shot.vertices for shot in shots]), full.faces, face)
    stated = np.sqrt(np.mean([shot.stated_mm**2 for shot in shots], axis=0))
    row: Row = {"shots": len(shots)} | found.figures(stated, areas, face)
    row |= {f"seen_{name}": value for name, value in found.figures(stated, areas, seen).items()}
    true = shots[0].truth
    place = rigid_fit(found.mean[face], true.vertices[face])
    distances = SurfaceIndex(true.vertices, true.faces, 1.0).closest(place.apply(found.mean[face])).distances
    row["warned"] = sum(bool(shot.warnings) for shot in shots)
    row["camera_moved"] = sum("camera-moved" in shot.warnings for shot in shots)
    row["repeated_mm"] = float(np.sqrt(np.average(distances**2, weights=areas[face])))
    return row
