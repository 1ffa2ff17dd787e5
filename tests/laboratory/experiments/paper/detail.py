"""Compares levels of detail: eigenheads alone, with kernel modes, and with photographs. ``surfaces`` has the hull.

Every figure is of a whole reconstruction from photographs: own masks, own alignment, calibration as given. Distances
are from the true face region, weighted by area, to the delivered surface, without realignment. Subjects:

- captures with a truth beside them (``<name>`` and ``<name>.truth``), rendered by another program;
- random heads of another population, with all its modes, photographed in the simulated studio;
- random heads of the model's own 60 modes in the same studio, which the span contains: what do more modes cost there?

Further figures: a moved camera and a wrong mask, and how many true vertices lie in the posterior's 95 % intervals along
the normal. Photographs that were not used are predicted by ``texture`` and ``real``.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import vertex_deviation_mm
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import vertex_areas
from pipeline.reconstruct import fit_shape
from pipeline.settings import Settings, document_from_settings
from pipeline.stages.alignment import align_head
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.faces import find_faces
from pipeline.stages.recorder import Recorder
from pipeline.stages.views import find_views
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject
from rig.studio.scene.visible import VisiblePoints
from rig.studio.sensor.faults import Fault
from rig.studio.sensor.preset import PRESET, Preset
from tests.laboratory.experiments.paper.span import weighted_quantile
from tests.laboratory.experiments.records import Bench, Outcome, Row
from tests.laboratory.experiments.surface.visible_surface import read_visible

Level = Literal["span", "kernel", "photo"]
LEVELS: tuple[Level, ...] = ("span", "kernel", "photo")
IN_SPAN_MODES, IN_SPAN_SPREAD = 60, 0.8  # section 5.2
FAULTS = {"bumped": Fault("bumped", "cam03", 0.1), "wrong-mask": Fault("wrong-mask", "cam03")}
FAR_MM = 8.0  # along a normal nothing is looked for beyond


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Holds a capture whose true surface is known."""

    name: str
    capture: Capture
    rig: Rig
    mesh: Mesh  # world frame
    face: Bool[np.ndarray, " v"]
    visible: VisiblePoints
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)  # world frame


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Holds the fit of one level of detail to a capture."""

    fit: Fit
    model: HeadModel  # with the modes that the fit has
    level: str
    seconds: float

    def mesh(self) -> Mesh:
        """Returns the fitted head on the full level, world frame, mm."""
        vertices = self.fit.world_from_head.apply(self.model.vertices(self.fit.coefficients))
        return Mesh(vertices, self.model.levels["full"].faces)


def run(
    models: Mapping[str, HeadModel],
    captures: Mapping[str, Path],
    *,
    renderer: Renderer,
    bench: Bench,
    others: HeadModel | None = None,
    subjects: int | None = None,
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``; ``figures`` is flat,
    ``<subject>_<model>_<level>_<quantity>``.

    Args:
        models: by the name in the figures; the first one is used for random heads and faults.
        captures: folders with a truth beside them.
        renderer: for the studio.
        others: the population from which random heads are drawn.
        subjects: number of random heads of it (20 by default), and of the first model's span (10 by default).
    """
    draws, in_span = subjects or 20, subjects or 10
    records = bench.records("detail", _key(models, others))
    label, model = next(iter(models.items()))
    jobs: list[Job] = []
    for name, path in captures.items():
        for other, with_model in models.items():
            jobs.append((f"{name}_{other}", partial(known_row, partial(read_known, path), with_model, renderer)))
    if others is not None:
        drawn = partial(photographed, others, len(others.modes), 1.0, renderer=renderer)
        jobs += [(f"draw-{i:02}_{label}", partial(known_row, partial(drawn, i), model, renderer)) for i in range(draws)]
        for kind, fault in FAULTS.items():
            jobs.append((f"{kind}_{label}", partial(known_row, partial(drawn, 0, fault=fault), model, renderer)))
    photographed_in_span = partial(photographed, model, IN_SPAN_MODES, IN_SPAN_SPREAD, renderer=renderer)
    jobs += [
        (f"inspan-{i:02}_{label}", partial(known_row, partial(photographed_in_span, i), model, renderer))
        for i in range(in_span)
    ]
    rows = []
    for done, (name, compute) in enumerate(jobs):
        rows.append({"name": name, **records.row(name, compute, done / len(jobs))})
    return {"figures": figures(rows), "rows": rows}


Job = tuple[str, Callable[[], Row]]


def read_known(folder: Path) -> Known:
    """Returns a capture folder and the truth beside it. Raises InputError."""
    capture, rig = read_capture(folder)
    truth = folder.with_name(folder.name + ".truth")
    mesh, face = read_mesh(truth / "head.ply"), np.load(truth / "face_mask.npy")
    return Known(folder.name, capture, rig, mesh, face, read_visible(truth))


def photographed(
    population: HeadModel,
    modes: int,
    spread: float,
    seed: int,
    *,
    renderer: Renderer,
    fault: Fault | None = None,
    preset: Preset = PRESET,
) -> Known:
    """Photographs a random head in the simulated studio. The same seed gives the same head, look and pose, whatever the
    fault."""
    rng = np.random.default_rng((9, seed))
    coefficients = spread * rng.standard_normal(modes)
    level = population.levels["full"]
    head = Mesh(population.vertices(coefficients), level.faces)
    marks = {name: head.vertices[row] for name, row in population.landmarks.items()}
    subject = Subject(head, marks, level.face_region, f"seed-{seed}")
    faults = () if fault is None else (fault,)
    shot = simulate(subject, default_layout(), preset, rng, renderer=renderer, faults=faults)
    head_world = shot.scene.head
    places = {name: head_world.vertices[row] for name, row in population.landmarks.items()}
    return Known(subject.name, shot.capture, shot.rig, head_world, level.face_region, shot.scene.visible, places)


def known_row(known: Callable[[], Known], model: HeadModel, renderer: Renderer) -> Row:
    """Runs every level of detail on one subject. Returns ``{level: {quantity: value}}``."""
    subject = known()
    return {
        level: {
            "reached": fitted.level,
            **surface_error(subject, fitted.mesh()),
            **posterior_cover(subject, fitted),
            "fit_s": fitted.seconds,
        }
        for level, fitted in every_level(subject.capture, subject.rig, model, LEVELS, renderer).items()
    }


def every_level(
    capture: Capture, rig: Rig, model: HeadModel, levels: tuple[Level, ...], renderer: Renderer
) -> dict[Level, Fitted]:
    """Fits every level of detail to a capture; masks and alignment are computed once for all."""
    context = ReconstructionContext(capture, rig, model, Settings(), renderer)
    views = find_views(context).product
    alignment = align_head(context, views, find_faces(context, views.capture).product).product
    fitted = {}
    for level in levels:
        began = time.perf_counter()
        at_level = replace(context, settings=replace(context.settings, detail=level))
        _, head = fit_shape(Recorder(at_level), views, alignment)
        fitted[level] = Fitted(head.fit, head.model, head.detail.level, time.perf_counter() - began)
    return fitted


def surface_error(known: Known, found: Mesh) -> dict[str, float]:
    """Returns distances (mm) of the true face to the found surface, weighted by area."""
    distances = SurfaceIndex(found.vertices, found.faces, 1.0).closest(known.mesh.vertices[known.face]).distances
    areas = vertex_areas(known.mesh.vertices, known.mesh.faces)[known.face]
    return {
        "median_mm": weighted_quantile(distances, areas, 0.5),
        "mean_mm": float(distances @ areas / areas.sum()),
        "p95_mm": weighted_quantile(distances, areas, 0.95),
    }


def posterior_cover(known: Known, fitted: Fitted) -> dict[str, float]:
    """Returns the share of the face's vertices whose 95 % interval along the normal holds the true surface."""
    mesh = fitted.mesh()
    rows = np.flatnonzero(fitted.model.levels["full"].face_region)[::5]
    deviation = vertex_deviation_mm(fitted.model, fitted.fit)[rows]
    across, found = along_normal(known, mesh.vertices[rows], mesh.normals()[rows])
    inside = np.abs(across[found]) < 1.96 * deviation[found]
    return {"cover_95": float(inside.mean()), "deviation_mm": float(np.median(deviation))}


def along_normal(
    known: Known, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Returns the signed distance (mm) along each normal to the true face, and where there is one."""
    kept = known.face[known.mesh.faces].all(axis=1)
    index = SurfaceIndex(known.mesh.vertices, known.mesh.faces[kept], 1.0)
    across = np.zeros(len(points))
    for _ in range(4):
        place = points + across[:, None] * normals
        hit = index.closest(place)
        slope = np.einsum("nc,nc->n", hit.normals, normals)
        step = np.einsum("nc,nc->n", hit.points - place, hit.normals) / np.maximum(slope, 0.3)
        across = np.clip(across + step, -FAR_MM, FAR_MM)
    end = index.closest(points + across[:, None] * normals)
    return across, (end.distances < 0.1) & (np.abs(across) < FAR_MM)


def figures(rows: list[Row]) -> dict[str, float]:
    """Summarises the rows: values of each subject, and means and worst values over random heads and heads in the
    span."""
    values: dict[str, list[float]] = {}
    for row in rows:
        subject, _, label = row["name"].rpartition("_")
        kind = subject.split("-")[0]
        group = {"draw": "draws", "inspan": "inspan"}.get(kind if subject[-1].isdigit() else "", subject)
        for level, quantities in row.items():
            if isinstance(quantities, Mapping):
                for quantity, value in quantities.items():
                    if isinstance(value, int | float):
                        values.setdefault(f"{group}_{label}_{level}_{quantity}", []).append(float(value))
    found = {}
    for name, of in values.items():
        found[name] = round(float(np.mean(of)), 4)
        if len(of) > 1:
            found[f"{name}_largest"], found[f"{name}_smallest"] = round(max(of), 4), round(min(of), 4)
    return found


def _key(models: Mapping[str, HeadModel], others: HeadModel | None) -> str:
    """What the rows depend on beside their names."""
    parts = {name: model.sha256 for name, model in models.items()} | {"others": others.sha256 if others else ""}
    parts["settings"] = json.dumps(document_from_settings(Settings()), sort_keys=True)
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
