"""Measures the whole visible surface: studio heads with every hair style of the studio, and captures with a truth
beside them.

Figures are recall and precision by part, errors of the face and of the head's regions, the difference between head.ply
and bust.ply, their normals, the bust's craters at highlights, and seconds; each surface is drawn in clay beside the
truth, and its craters on the truth. ``precision`` is of the whole closed surface
within 25 mm of what is seen. The surface's guess at what nobody sees begins there, too, so that no closed surface
reaches 1. ``precision_seen`` is of what the file itself calls seen.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.fusion.fusion import BustSurface
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.head_model.subdivision import vertex_areas
from pipeline.part_labels.codes import Part
from pipeline.reconstruct import reconstruct
from pipeline.results.overlays import clay
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from rig.errors import EigenheadError
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene.visible import PARTS, VisiblePoints
from rig.studio.sensor.preset import PRESET, made_real
from tests.laboratory.experiments.paper.detail import (
    IN_SPAN_MODES,
    IN_SPAN_SPREAD,
    Known,
    photographed,
    read_known,
    surface_error,
)
from tests.laboratory.experiments.paper.span import weighted_quantile
from tests.laboratory.experiments.pictures import labelled
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by
from tests.laboratory.experiments.surface.face_skin import (
    crater_map,
    face_places,
    find_craters,
    normal_figures,
    shining_places,
)
from tests.laboratory.experiments.surface.skin_colours import wrong_colours
from tests.laboratory.experiments.surface.visible_surface import score_visible

STYLES = (
    "short", "over-ears", "long", "curly", "fringe", "bun", "beard", "bald", "cap", "glasses", "long,beard",
    "curly,glasses",
)  # fmt: skip
SPLAT_MM = 1.8  # half the side of a point of the truth in pictures: points are 1.5 mm apart in the mean
AZIMUTHS_DEG = (30.0, -75.0)
SEEN_MM = 2.0  # from a visible point, 1.5 mm apart
MIN_PLACES = 50  # of a region, for figures of its own
REGIONS_SCORED = "face", "eyes", "nose", "mouth", "ears"  # the neck ends where each model ends it, hair hides the rest


def visible(
    model: HeadModel,
    captures: Mapping[str, Path],
    *,
    renderer: Renderer,
    bench: Bench,
    subjects: int = len(STYLES),
    realism: tuple[str, ...] = (),
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``; a figure is ``<group>_<quantity>``,
    the mean over the group: ``studio``, ``real`` (the same heads with ``realism``), or a capture by its name.

    ``model``: fitted; heads are drawn from it, too. ``captures``: folders with a truth beside them, by name.
    ``renderer``: for the studio. ``subjects``: heads in the studio, with the hair styles of ``STYLES`` in turn.
    ``realism``: names of ``rig.studio.sensor.preset``, with which each head is photographed once more.
    """
    records = bench.records("visible", key_of(model.sha256, Settings()))
    jobs: list[tuple[str, str, Callable[[], Known]]] = []
    for number in range(subjects):
        style = STYLES[number % len(STYLES)]
        preset = replace(PRESET, hairstyle=tuple(style.split(",")))
        draw = partial(photographed, model, IN_SPAN_MODES, IN_SPAN_SPREAD, 300 + number, renderer=renderer)
        name = f"{number:02}-{style.replace(',', '-')}"
        jobs.append(("studio", name, partial(draw, preset=preset)))
        if realism:
            jobs.append(("real", f"{name}-{'-'.join(realism)}", partial(draw, preset=made_real(preset, realism))))
    jobs += [(name, name, partial(read_known, path)) for name, path in captures.items()]
    rows = []
    for done, (group, name, read) in enumerate(jobs):
        picture = None if bench.folder is None else bench.folder / f"visible-{name}.png"
        compute = partial(known_row, read, model, renderer, picture)
        rows.append({"name": name, "group": group, **records.row(name, compute, done / len(jobs))})
    return {"figures": means_by(rows, "group"), "rows": rows}


def known_row(known: Callable[[], Known], model: HeadModel, renderer: Renderer, picture: Path | None) -> Row:
    """Runs the default job on one subject, and returns its figures."""
    subject, before = known(), time.process_time()
    found = reconstruct(ReconstructionContext(subject.capture, subject.rig, model, Settings(), renderer))
    seconds = time.process_time() - before
    if found.bust is None:
        raise EigenheadError(f"{subject.name}: no bust ({'; '.join(str(warning) for warning in found.warnings)})")
    bust = found.bust.surface
    in_head = found.head.fit.world_from_head.inverse()
    if picture is not None:
        meshes = {"truth": splats(subject.visible), "bust.ply": bust.mesh_world, "head.ply": found.mesh_world}
        write_image(
            picture, _row(subject.name, {k: Mesh(in_head.apply(m.vertices), m.faces) for k, m in meshes.items()})
        )
    places = face_places(subject)
    shining = shining_places(places, subject.capture.images, subject.rig, subject.mesh)
    craters = find_craters(places, bust.mesh_world, shining)
    if picture is not None:
        true_local = Mesh(in_head.apply(subject.mesh.vertices), subject.mesh.faces)
        drawn = crater_map(craters, in_head.apply(places.points), true_local)
        write_image(picture.with_name(f"{picture.stem}-craters.png"), drawn)
    whole = score_visible(subject.visible, bust.mesh_world)
    faces = {"head": found.mesh_world, "bust": bust.mesh_world}
    seen = score_visible(subject.visible, seen_of(bust))
    return {
        **{k: value for k, value in whole.flat().items() if k.endswith(("within_2mm", "median", "closed", "_p95"))},
        **{f"precision_seen_{part}_within_2mm": figures["within_2mm"] for part, figures in seen.precision.items()},
        **{f"{k}_face_{key}": v for k, mesh in faces.items() for key, v in surface_error(subject, mesh).items()},
        **{f"{k}_{key}": v for k, mesh in faces.items() for key, v in normal_figures(places, mesh).items()},
        **craters.figures(),
        **wrong_colours(subject, found, model),
        **region_errors(subject, found.mesh_world, head_regions(model)),
        "head_to_bust_median_mm": float(np.median(head_to_bust(found.mesh_world, bust))),
        "cpu_s": seconds,
        "warnings": sorted({warning.code for warning in found.warnings}),
    }


def region_errors(known: Known, head_world: Mesh, regions: Mapping[str, Bool[np.ndarray, " v"]]) -> dict[str, float]:
    """Returns median, mean and 95th percentile (mm, by area) of the distance of true skin that two cameras see to the
    head, by region of the head, which is transferred to the truth by the nearest vertex."""
    skin = known.visible.points[known.visible.part == PARTS.index("head")].astype(float)
    seen = np.flatnonzero(KDTree(skin).query(known.mesh.vertices, distance_upper_bound=SEEN_MM)[0] < SEEN_MM)
    hit = SurfaceIndex(head_world.vertices, head_world.faces, 1.0).closest(known.mesh.vertices[seen])
    corner = head_world.faces[hit.triangles]
    nearest = np.take_along_axis(corner, hit.weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    area = vertex_areas(known.mesh.vertices, known.mesh.faces)[seen]
    found: dict[str, float] = {}
    for name, region in regions.items():
        off, weight = hit.distances[region[nearest]], area[region[nearest]]
        if name in REGIONS_SCORED and len(off) >= MIN_PLACES:
            found |= {
                f"head_{name}_seen_median_mm": weighted_quantile(off, weight, 0.5),
                f"head_{name}_seen_mean_mm": float(off @ weight / weight.sum()),
                f"head_{name}_seen_p95_mm": weighted_quantile(off, weight, 0.95),
            }
    return found


def seen_of(bust: BustSurface) -> Mesh:
    """Returns the triangles all of whose corners a photograph shows."""
    return Mesh(bust.mesh_world.vertices, bust.mesh_world.faces[bust.seen[bust.mesh_world.faces].all(axis=1)])


def head_to_bust(head_world: Mesh, bust: BustSurface) -> Float[np.ndarray, " n"]:
    """Returns the distances (mm) of the bust's visible skin to the head, where the head is within 5 mm."""
    skin = bust.mesh_world.vertices[bust.part == Part.SKIN]
    far = SurfaceIndex(head_world.vertices, head_world.faces, 1.0).closest(skin).distances
    return far[far < 5.0]


def splats(points: VisiblePoints) -> Mesh:
    """Returns a small square around each point, across its normal, to draw a truth that consists of points."""
    normals = points.normals.astype(float)
    aside = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    aside *= SPLAT_MM / np.linalg.norm(aside, axis=1, keepdims=True)
    along = np.cross(normals, aside)
    corners = [points.points + i * aside + j * along for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    first = 4 * np.arange(len(normals))[:, None]
    faces = np.concatenate([first + np.array([[0, 1, 2]]), first + np.array([[0, 2, 3]])])
    return Mesh(np.stack(corners, axis=1).reshape(-1, 3), faces.astype(np.int32))


def _row(name: str, in_head: Mapping[str, Mesh]) -> np.ndarray:
    low, high = in_head["bust.ply"].vertices.min(axis=0), in_head["bust.ply"].vertices.max(axis=0)
    return np.hstack(
        [
            labelled(clay(mesh, azimuth_deg=azimuth, box=(low, high)), f"{name}: {title}")
            for azimuth in AZIMUTHS_DEG
            for title, mesh in in_head.items()
        ]
    )
