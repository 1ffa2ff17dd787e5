"""Measures the cranium under a swim or wig cap, with and without being told of the cap.

Heads of two populations sit in the studio with caps of several colours, two of them with folds at the edge. Each is
reconstructed from the same outlines, once as any capture and once with the cap's colour, by name, and its thickness.
Distances are from the true scalp under the cap to the delivered head; the girth is the tape around both, as ``measure``
takes it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.clinic.anatomical_frame import frankfurt_axes
from pipeline.applications.clinic.fitting import UprightHead, head_circumference
from pipeline.applications.verification.measured import Measured
from pipeline.contour_fit import bare_outline, noise_model
from pipeline.detail import dense_points
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.head_model.subdivision import vertex_areas
from pipeline.part_labels import cap as cap_finder
from pipeline.reconstruct import reconstruct
from pipeline.segmentation.segment import segment
from pipeline.settings import CapSettings, OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.colour_space import linear_from_srgb
from rig.geometry import RigidTransform
from rig.mesh import Mesh
from rig.progress import discard_progress
from rig.render.renderer import Renderer
from rig.studio.scene.anatomy import anatomy
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.scene.subject import Look, Subject, random_look, restyle
from rig.studio.scene.worn import TightCap, above_edge_mm
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.detail import IN_SPAN_MODES, IN_SPAN_SPREAD
from tests.laboratory.experiments.paper.span import weighted_quantile
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by


@dataclass(frozen=True, slots=True)
class Worn:
    """Describes a cap of the experiment: how the studio makes it, and the name by which its colour is stated."""

    cap: TightCap
    stated: str


def _cap(code: str, stated: str, thickness_mm: float = 1.0, folds_mm: float = 0.0) -> Worn:
    srgb = np.array([int(code[at : at + 2], 16) for at in (1, 3, 5)]) / 255.0
    red, green, blue = linear_from_srgb(srgb).tolist()
    creases = 0.5 if folds_mm else 0.0
    return Worn(TightCap((red, green, blue), thickness_mm, folds_mm, creases, glossy=not folds_mm), stated)


CAPS = (
    _cap("#2458ac", "blue"),
    _cap("#24221f", "black", 1.2, folds_mm=2.0),
    _cap("#d8d6d0", "white", 0.6),
    _cap("#3f8f4a", "green", 1.5, folds_mm=2.0),
)
SEED = 11
STYLES = ("bald", "short", "over-ears", "long", "curly")


def capped(
    model: HeadModel, *, renderer: Renderer, bench: Bench, others: HeadModel | None = None, subjects: int = 4
) -> Outcome:
    """Runs this module's experiment: ``subjects`` heads of the model's span and as many of ``others``, each with the
    next cap. Figures are ``<group>_<without|with>_<cranium|girth|stated>_mm``: means over the group (``own``,
    ``others``) of the median distance, of the absolute error of the girth, and of the median stated deviation."""
    records = bench.records("capped", key_of(model.sha256, Settings(), cap_finder, bare_outline, dense_points))
    populations = {"own": (model, IN_SPAN_MODES, IN_SPAN_SPREAD)}
    if others is not None:
        populations["others"] = (others, len(others.modes), 1.0)
    jobs = [(group, number) for group in populations for number in range(subjects)]
    rows = []
    for done, (group, number) in enumerate(jobs):
        worn = CAPS[number % len(CAPS)]
        name = f"{group}-{number:02}-{worn.stated}"
        made = partial(_row, model, *populations[group], number, worn, renderer=renderer)
        rows.append({"name": name, "group": group, **records.row(name, made, done / len(jobs))})
    found = figures(rows)
    return {"figures": found, "rows": rows, "markdown": as_markdown(rows)}


def _row(
    model: HeadModel, population: HeadModel, modes: int, spread: float, number: int, worn: Worn, *, renderer: Renderer
) -> Row:
    """Returns one head's figures: ``{without|with: {quantity: value}}``."""
    shot, scalp = photograph_scalp(
        population, modes, spread, number, lambda look: replace(look, hair=None, tight_cap=worn.cap), renderer
    )
    silhouettes = segment(shot.capture, shot.rig, report=discard_progress)
    ways = {"without": CapSettings(), "with": CapSettings(worn.stated, worn.cap.thickness_mm)}
    ears = head_regions(population)["ears"]
    found: Row = {"cap": worn.stated}
    for way, cap in ways.items():
        settings = Settings(cap=cap, outputs=OutputSettings(surface="head"))
        context = ReconstructionContext(
            shot.capture, shot.rig, model, settings, renderer, segment=lambda *_, report: silhouettes
        )
        done = reconstruct(context)
        landmarks = {name: mark.position_mm for name, mark in done.evidence.landmarks.items()}
        girth = girth_mm(
            done.mesh_world, landmarks, head_regions(model)["ears"], done.head.fit.world_from_head.rotation
        )
        found[way] = {
            "cranium": done.head.cranium or "",
            **cranium_figures(shot, scalp, done.mesh_world, done.refined.deviation_mm),
            "girth_error_mm": girth - _true_girth(shot, ears),
        }
    return found


def photograph_scalp(
    population: HeadModel, modes: int, spread: float, number: int, dress: Callable[[Look], Look], renderer: Renderer
) -> tuple[SimulatedCapture, Bool[np.ndarray, " v"]]:
    """Photographs head ``number`` of a population with a look that ``dress`` changes. Returns which of its vertices
    are scalp, where a cap sits, too."""
    rng = np.random.default_rng((SEED, number))
    level = population.levels["full"]
    head = Mesh(population.vertices(spread * rng.standard_normal(modes)), level.faces)
    marks = {name: head.vertices[row] for name, row in population.landmarks.items()}
    subject = Subject(head, marks, level.face_region, f"head-{number}")
    shot = simulate(subject, default_layout(), PRESET, rng, renderer=renderer, look=dress(random_look(rng)))
    return shot, above_edge_mm(head.vertices, anatomy(head.vertices, marks)) > 0.0


def skulls(
    model: HeadModel, *, renderer: Renderer, bench: Bench, others: HeadModel | None = None, subjects: int = 10
) -> Outcome:
    """Counts which of ``subjects`` heads with each of ``STYLES`` are called bald, and measures the cranium of all, seen
    or under hair. Heads come from the model's span and from ``others`` in turn. Figures are means over each style,
    ``<style>_called_bald`` and ``<style>_within_2_mm`` shares of heads."""
    records, rows = bench.records("skulls", key_of(model.sha256, Settings(), bare_outline, noise_model)), list[Row]()
    populations = [(model, IN_SPAN_MODES, IN_SPAN_SPREAD)]
    if others is not None:
        populations.append((others, len(others.modes), 1.0))
    for style, number in product(STYLES, range(subjects)):
        drawn, name = populations[number % len(populations)], f"{style}-{number:02}"
        made = partial(_skull, model, *drawn, number, style, renderer=renderer)
        rows.append({"name": name, "style": style, **records.row(name, made, number / subjects)})
    return {"figures": means_by(rows, "style"), "rows": rows}


def _skull(
    model: HeadModel, population: HeadModel, modes: int, spread: float, number: int, style: str, *, renderer: Renderer
) -> Row:
    """Returns the figures of one head's cranium, and whether it is called bald."""
    shot, scalp = photograph_scalp(population, modes, spread, number, lambda look: restyle(look, [style]), renderer)
    settings = Settings(detail="photo", outputs=OutputSettings(surface="head"))
    done = reconstruct(ReconstructionContext(shot.capture, shot.rig, model, settings, renderer))
    found = cranium_figures(shot, scalp, done.mesh_world, done.refined.deviation_mm)
    bald = float(done.head.cranium == "bald")
    return found | {"called_bald": bald, "within_2_mm": float(found["cranium_mm"] < 2.0)}


def cranium_figures(
    shot: SimulatedCapture, scalp: Bool[np.ndarray, " v"], head_world: Mesh, deviation_mm: Float[np.ndarray, " w"]
) -> dict[str, float]:
    """Returns the median and the 90 % quantile of the distance (mm) from the true scalp to a delivered head, the
    median stated deviation there, and the share within 1.96 of it; weighted by area."""
    true = shot.scene.head
    hit = SurfaceIndex(head_world.vertices, head_world.faces, 1.0).closest(true.vertices[scalp])
    area = vertex_areas(true.vertices, true.faces)[scalp]
    stated = (deviation_mm[head_world.faces[hit.triangles]] * hit.weights).sum(axis=1)
    return {
        "cranium_mm": weighted_quantile(hit.distances, area, 0.5),
        "cranium_90_mm": weighted_quantile(hit.distances, area, 0.9),
        "stated_mm": weighted_quantile(stated, area, 0.5),
        "within_95": float((hit.distances < 1.96 * stated) @ area / area.sum()),
    }


def _true_girth(shot: SimulatedCapture, ears: Bool[np.ndarray, " v"]) -> float:
    return girth_mm(shot.scene.head, shot.scene.landmarks_world, ears, shot.scene.world_from_head.rotation)


def girth_mm(
    head_world: Mesh,
    landmarks_world: Mapping[str, Float[np.ndarray, " 3"]],
    ears: Bool[np.ndarray, " v"],
    turn: Float[np.ndarray, "3 3"],
) -> float:
    """Returns the length of the tape around a head (mm), whose landmarks and attitude (``turn``, world from head) are
    known. Raises ValueError for a head without a cranium."""
    still = RigidTransform(turn.T, np.zeros(3))
    none = np.zeros(len(head_world.vertices))
    frame = frankfurt_axes(Measured("head", head_world, none, none, {}, landmarks_world, still), "RAS")
    motion = frame.patient_from_world
    marks = {name: motion.apply(point) for name, point in landmarks_world.items()}
    around = head_circumference(UprightHead(motion.apply(head_world.vertices), head_world.faces, marks, ears))
    if around is None:
        raise ValueError("the head has no cranium")
    return around


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Returns means over the heads of each group, of the girth's absolute error."""
    ways = [(row["group"], way, row[way]) for row in rows for way in ("without", "with")]
    errors = [of | {"way": f"{group}_{way}", "girth_error_mm": abs(of["girth_error_mm"])} for group, way, of in ways]
    return means_by(errors, "way")


def as_markdown(rows: Sequence[Row]) -> str:
    """Returns a table: a row a head, each figure without and with the cap's colour."""
    columns = ("cranium", "cranium_mm", "cranium_90_mm", "stated_mm", "within_95", "girth_error_mm")

    def cell(row: Row, column: str) -> str:
        pair = (row[way][column] for way in ("without", "with"))
        return " / ".join(each if isinstance(each, str) else f"{each:.2f}" for each in pair)

    header = ("without / with `--cap`", *(column.replace("_", " ") for column in columns))
    return markdown.table(header, [[row["name"], *(cell(row, column) for column in columns)] for row in rows])
