"""Measures skin that cameras see and skin that hair or clothes hide, separately and by region: errors, and how often
the stated interval contains the truth, at every level of detail; the same for landmarks and measurements.

Subjects are heads of the model's span in the studio, with hair over ears and forehead; heads of another population
there, with any hair; and on request captures with a truth beside them. Each is reconstructed at every level, from the
same silhouettes. Distances are from the true surface to the delivered head, weighted by area. Regions are the model's,
transferred to the truth by the nearest vertex. A point lies in its interval if that distance is below 1.96 times the
deviation (``quality``) stated there. Nostrils and the inside of the mouth, which are hardly visible from any direction,
do not count.

A landmark counts by its coordinates, a measurement by its length. Another population has its landmarks where its makers
placed them, millimetres along the surface from this project's; that counts as error, as for anybody who compares two
programs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.contour_fit import contour, posterior
from pipeline.evidence import measurements
from pipeline.evidence.measurements import DISTANCES, Landmark, Measurement
from pipeline.geometry.projection import camera_depths, depth_map
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.head_model.subdivision import vertex_areas
from pipeline.imaging.silhouette import Silhouette
from pipeline.photometric_fit import refine as photo_refine
from pipeline.reconstruct import reconstruct
from pipeline.segmentation.segment import segment
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.geometry import look_at
from rig.mesh import Mesh, boundary_edges
from rig.progress import Progress, discard_progress
from rig.render.renderer import Renderer
from rig.studio.scene.visible import PARTS
from rig.studio.sensor.preset import PRESET, made_real
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.detail import IN_SPAN_MODES, IN_SPAN_SPREAD, Known, photographed, read_known
from tests.laboratory.experiments.paper.span import weighted_quantile
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by

Level = Literal["span", "kernel", "photo", "fine"]
HEAVY_HAIR = replace(PRESET, hairstyle=("fringe",))  # over the ears and 30 mm down the forehead
SEEN_MM, HIDDEN_MM = 2.0, 4.0  # from the visible points, 1.5 mm apart; what lies between is neither
INTERVAL = 1.96  # standard deviations that hold 95 %
FIRST_SEED = 4  # on the heads before it what intervals assume of unseen skin was measured
OUTSIDE_MM, OUTSIDE_DIRECTIONS, OUTSIDE_PX = 3000.0, 64, 320  # from how far, how many and how finely a head is looked
# at
REACHED_MM = 1.5  # a surface in front of a place by less is its own
MIN_DIRECTIONS = 8  # skin under hair is seen from 16 and more, a nostril and the inside of a mouth from 6 at most
MIN_PLACES = 50  # of a region, for figures of its own
LEVELS: tuple[Level, ...] = ("span", "kernel", "photo", "fine")
# Groups every subject of which counts alike in the figures of all populations together.
POOLED = {"studio": "all", "draws": "all", "studio-real": "all-real", "draws-real": "all-real"}


def hidden(
    model: HeadModel,
    captures: Mapping[str, Path],
    *,
    renderer: Renderer,
    bench: Bench,
    others: HeadModel | None = None,
    subjects: int = 4,
    realism: tuple[str, ...] = (),
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``. A figure is
    ``<group>_<level>_<seen|hidden>_<region>_<quantity>`` or ``<group>_<level>_<landmarks|measurements>_within_95``, the
    mean over the group: ``studio``, ``draws``, both as ``all``; the same with ``realism`` as ``studio-real``,
    ``draws-real`` and ``all-real``; or a capture by its name.

    ``model``: fitted; heads are drawn from it, too. ``captures``: folders with a truth beside them, by name.
    ``renderer``: for the studio. ``others``: another population, from which as many heads are drawn. ``subjects``:
    heads of each population. ``realism``: names of ``rig.studio.sensor.preset``, with which each head is photographed
    once more.
    """
    key = key_of(
        model.sha256, others.sha256 if others else "", Settings(), posterior, contour, photo_refine, measurements
    )
    records = bench.records("hidden", key)
    seeds = range(FIRST_SEED, FIRST_SEED + subjects)
    jobs: list[tuple[str, str, Callable[[], Known]]] = []
    for suffix, names in (("", ()), ("-real", realism)) if realism else (("", ()),):
        end = "-".join(("", *names))
        heavy, plain = made_real(HEAVY_HAIR, names), made_real(PRESET, names)
        drawn = partial(photographed, model, IN_SPAN_MODES, IN_SPAN_SPREAD, renderer=renderer, preset=heavy)
        jobs += [(f"studio{suffix}", f"studio-{seed:02}{end}", partial(drawn, seed)) for seed in seeds]
        if others is not None:
            drawn = partial(photographed, others, len(others.modes), 1.0, renderer=renderer, preset=plain)
            jobs += [(f"draws{suffix}", f"draw-{seed:02}{end}", partial(drawn, seed)) for seed in seeds]
    jobs += [(name, name, partial(read_known, path)) for name, path in captures.items()]
    rows = []
    for done, (group, name, read) in enumerate(jobs):
        bench.report(name, done / len(jobs))
        rows.append({"name": name, "group": group, **records.row(name, partial(known_row, read, model, renderer))})
    found = figures(rows)
    return {"figures": found, "rows": rows, "markdown": as_markdown(found)}


def known_row(known: Callable[[], Known], model: HeadModel, renderer: Renderer) -> Row:
    """Returns one subject: ``{level: {<seen|hidden>_<region>_<quantity>: value}}``."""
    subject = known()
    silhouettes = segment(subject.capture, subject.rig, report=discard_progress)

    def segmented(capture: Capture, *_: object, report: Progress) -> dict[str, Silhouette]:
        """Returns the same for every level; pictures that were put right are segmented anew."""
        again = capture is not subject.capture
        return segment(capture, subject.rig, report=report) if again else silhouettes

    found: Row = {}
    for level in LEVELS:
        settings = Settings(detail=level, outputs=OutputSettings(surface="head"))
        done = reconstruct(
            ReconstructionContext(subject.capture, subject.rig, model, settings, renderer, segment=segmented)
        )
        found[level] = {
            "reached": done.refined.detail.level,
            **skin_figures(subject, done.mesh_world, done.refined.deviation_mm, head_regions(model)),
            **landmark_figures(subject.landmarks, done.evidence.landmarks, done.evidence.measurements),
        }
    return found


def landmark_figures(
    true: Mapping[str, Float[np.ndarray, " 3"]], found: Mapping[str, Landmark], lengths: Mapping[str, Measurement]
) -> dict[str, float]:
    """Returns the median error and stated deviation (mm), and the share within 95 % intervals, of landmarks (by
    coordinate) and of measurements; empty if no landmark is known.

    Args:
        true: the true landmarks, world frame, mm, by name.
        found: those of the delivered head.
        lengths: the measurements of the delivered head.
    """
    off, stated = [], []
    for name, mark in found.items():
        if name in true and mark.std_mm is not None:
            off.append(mark.position_mm - true[name])
            stated.append(mark.std_mm)
    measured = [
        (abs(lengths[name].value_mm - float(np.linalg.norm(true[one] - true[two]))), lengths[name].std_mm)
        for name, (one, two) in DISTANCES.items()
        if name in lengths and one in true and two in true
    ]
    if not off or not measured:
        return {}
    errors, deviations = np.array(off), np.array(stated)
    wrong, said = np.array(measured, float).T
    return {
        "landmarks_median_mm": float(np.median(np.linalg.norm(errors, axis=1))),
        "landmarks_stated_mm": float(np.median(np.linalg.norm(deviations, axis=1))),
        "landmarks_within_95": float((np.abs(errors) < INTERVAL * deviations).mean()),
        "measurements_median_mm": float(np.median(wrong)),
        "measurements_stated_mm": float(np.median(said)),
        "measurements_within_95": float((wrong < INTERVAL * said).mean()),
    }


def skin_figures(
    known: Known, head_world: Mesh, deviation_mm: Float[np.ndarray, " v"], regions: Mapping[str, Bool[np.ndarray, " v"]]
) -> dict[str, float]:
    """Returns the median distance (mm), the share within the stated interval, and the median stated deviation (mm) of
    the true skin, by whether it is seen and by region; the region ``all`` is all of them together.

    ``known``: the truth, with its visible points. ``head_world``: the delivered head, mm. ``deviation_mm``: stated at
    its vertices. ``regions``: of its vertices, by name.
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
    hidden_skin = (far > HIDDEN_MM) & reached_from_outside(known.mesh)
    found: dict[str, float] = {}
    for kind, shown in {"seen": far < SEEN_MM, "hidden": hidden_skin}.items():
        for name, region in {"all": np.ones(len(deviation_mm), bool), **regions}.items():
            rows = np.flatnonzero(shown & region[nearest] & ~open_end)
            if len(rows) < MIN_PLACES:
                continue
            within = hit.distances[rows] < INTERVAL * stated[rows]
            found |= {
                f"{kind}_{name}_median_mm": weighted_quantile(hit.distances[rows], area[rows], 0.5),
                f"{kind}_{name}_within_95": float(within @ area[rows] / area[rows].sum()),
                f"{kind}_{name}_stated_mm": weighted_quantile(stated[rows], area[rows], 0.5),
            }
    return found


def reached_from_outside(mesh: Mesh) -> Bool[np.ndarray, " v"]:
    """Tells which vertices are visible from several directions far away; nostrils and the inside of a mouth are not."""
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    radius = float(np.linalg.norm(mesh.vertices - centre, axis=1).max())
    focal, middle = 0.5 * OUTSIDE_PX * OUTSIDE_MM / (1.05 * radius), 0.5 * (OUTSIDE_PX - 1)
    lens = Intrinsics(OUTSIDE_PX, OUTSIDE_PX, focal, focal, middle, middle)
    step = np.arange(OUTSIDE_DIRECTIONS) + 0.5  # a Fibonacci lattice
    height, turn = 1.0 - 2.0 * step / OUTSIDE_DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * step
    flat = np.sqrt(1.0 - height**2)
    directions = np.zeros(len(mesh.vertices), int)
    for direction in np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], axis=1):
        camera = Camera(
            "outside", lens, look_at(centre + OUTSIDE_MM * direction, centre, np.eye(3)[np.abs(direction).argmin()])
        )
        depth, _ = depth_map(camera, mesh.vertices, mesh.faces)
        column, row = np.rint(camera.project(mesh.vertices)).astype(int).T
        directions += camera_depths(camera, mesh.vertices) < depth[row, column] + REACHED_MM
    return directions >= MIN_DIRECTIONS


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Returns means over the subjects of each group, and over those of all populations together."""
    pooled: list[Row] = [row | {"group": POOLED[row["group"]]} for row in rows if row["group"] in POOLED]
    every = [row.get(level, {}) | {"of": f"{row['group']}_{level}"} for row in (*rows, *pooled) for level in LEVELS]
    return means_by(every, "of")


def as_markdown(found: Mapping[str, float]) -> str:
    """Returns a Markdown table: shares within 95 % intervals by group and level, and median error and deviation of seen
    and of hidden skin."""
    columns = ("seen_all", "seen_face", "hidden_all", "hidden_face", "landmarks", "measurements")
    present = [key.removesuffix("_seen_all_within_95") for key in found if key.endswith("_seen_all_within_95")]
    rows = [
        [
            place.replace("_", " "),
            *(
                " / ".join(
                    f"{found[f'{place}_{column}_{what}']:.3g}" for what in ("within_95", "median_mm", "stated_mm")
                )
                if f"{place}_{column}_within_95" in found
                else ""
                for column in columns
            ),
        ]
        for place in present
    ]
    header = ("within 95 % / median mm / stated mm", *(column.replace("_", " ") for column in columns))
    return markdown.table(header, rows)
