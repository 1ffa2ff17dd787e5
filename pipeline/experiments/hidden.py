"""Skin that the cameras see and skin that hair or clothes hide, apart and by region: error, and how often the stated
interval holds it.

Subjects are heads of the model's span in the studio, under hair that covers ears and forehead, and, where asked for,
captures with a truth beside them. Each is reconstructed whole, at level ``fine``. Distances are from the true surface
to the head as delivered, weighted by area; regions are the model's, carried to the truth by the nearest vertex. A place
lies within its interval where that distance is below 1.96 times the deviation (``quality``) stated there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.eigenheads.correspondence.closest import SurfaceIndex
from pipeline.eigenheads.model import HeadModel
from pipeline.eigenheads.regions import head_regions
from pipeline.eigenheads.subdivision import vertex_areas
from pipeline.experiments.detail import IN_SPAN_MODES, IN_SPAN_SPREAD, Known, photographed, read_known
from pipeline.experiments.outcome import Outcome, Row
from pipeline.experiments.records import Records, key_of
from pipeline.experiments.span import weighted_quantile
from pipeline.reconstruct import reconstruct
from pipeline.settings import OutputSettings, Settings
from rig.mesh import Mesh, boundary_edges
from rig.render.renderer import Renderer
from rig.studio.scene.visible import PARTS
from rig.studio.sensor.preset import PRESET

Report = Callable[[str, float], None]
HEAVY_HAIR = replace(PRESET, hairstyle=("fringe",))  # over the ears and 30 mm down the forehead
SEEN_MM, HIDDEN_MM = 2.0, 4.0  # from the visible points, 1.5 mm apart; what lies between is neither
INTERVAL = 1.96  # standard deviations that hold 95 %
LEAST_PLACES = 50  # of a region, for figures of its own


def hidden(
    model: HeadModel,
    captures: Mapping[str, Path],
    *,
    renderer: Renderer,
    report: Report,
    subjects: int = 8,
    folder: Path | None = None,
) -> Outcome:
    """``{"figures": {...}, "rows": [...]}``; a figure is ``<group>_<seen|hidden>_<region>_<quantity>``, the mean over
    the group: ``studio``, or a capture by its name.

    Args:
        model: fitted, and drawn from.
        captures: folders with a truth beside them, by name.
        renderer: for the studio.
        report: told the subject and the share done.
        subjects: heads in the studio.
        folder: keeps rows, so that a stopped run goes on.
    """
    records = Records(folder, "hidden", key_of(model.sha256, Settings()))
    drawn = partial(photographed, model, IN_SPAN_MODES, IN_SPAN_SPREAD, renderer=renderer, preset=HEAVY_HAIR)
    jobs = [("studio", f"studio-{seed:02}", partial(drawn, seed)) for seed in range(subjects)]
    jobs += [(name, name, partial(read_known, path)) for name, path in captures.items()]
    rows = []
    for done, (group, name, read) in enumerate(jobs):
        report(name, done / len(jobs))
        rows.append({"name": name, "group": group, **records.row(name, partial(known_row, read, model, renderer))})
    report("done", 1.0)
    return {"figures": figures(rows), "rows": rows}


def known_row(known: Callable[[], Known], model: HeadModel, renderer: Renderer) -> Row:
    """One subject: ``{<seen|hidden>_<region>_<quantity>: value}``, by level ``fine``."""
    subject, settings = known(), Settings(detail="fine", outputs=OutputSettings(surface="head"))
    found = reconstruct(subject.capture, subject.rig, model, settings, renderer=renderer, report=_silent)
    measured = skin_figures(subject, found.mesh_world, found.quality_mm, head_regions(model))
    return {"level": found.detail.level, **measured}


def _silent(stage: str, fraction: float) -> None:
    pass


def skin_figures(
    known: Known,
    head_world: Mesh,
    deviation_mm: Float[np.ndarray, " v"],
    regions: Mapping[str, Bool[np.ndarray, " v"]],
) -> dict[str, float]:
    """Median distance (mm), share within the stated interval and median stated deviation (mm) of the true skin, by
    what is seen of it and by region; ``all`` are all of them together.

    Args:
        known: the truth, with its visible points.
        head_world: the head as delivered, mm.
        deviation_mm: stated at its vertices.
        regions: of its vertices, by name.
    """
    hit = SurfaceIndex(head_world.vertices, head_world.faces, 1.0).closest(known.mesh.vertices)
    corner = head_world.faces[hit.triangles]
    nearest = np.take_along_axis(corner, hit.weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    stated = (deviation_mm[corner] * hit.weights).sum(axis=1)
    area = vertex_areas(known.mesh.vertices, known.mesh.faces)
    # Beyond the open end of the head's neck there is nothing to compare with.
    open_end = np.isin(corner, np.unique(boundary_edges(head_world.faces))).any(axis=1)
    points = known.visible.points[known.visible.part == PARTS.index("head")].astype(float)
    far, _ = KDTree(points).query(known.mesh.vertices)
    found: dict[str, float] = {}
    for kind, shown in {"seen": far < SEEN_MM, "hidden": far > HIDDEN_MM}.items():
        for name, region in {"all": np.ones(len(deviation_mm), bool), **regions}.items():
            rows = np.flatnonzero(shown & region[nearest] & ~open_end)
            if len(rows) < LEAST_PLACES:
                continue
            within = hit.distances[rows] < INTERVAL * stated[rows]
            found |= {
                f"{kind}_{name}_median_mm": weighted_quantile(hit.distances[rows], area[rows], 0.5),
                f"{kind}_{name}_within_95": float(within @ area[rows] / area[rows].sum()),
                f"{kind}_{name}_stated_mm": weighted_quantile(stated[rows], area[rows], 0.5),
            }
    return found


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Means over the subjects of each group, of what they have."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if isinstance(value, float):
                values.setdefault(f"{row['group']}_{key}", []).append(value)
    return {key: float(np.mean(found)) for key, found in values.items()}
