"""Compares the whole visible surface with other programs' results: the same photographs and masks, one scorer,
processor seconds.

- ``eigenhead``: bust.ply of the default job, which also makes head.ply.
- ``hull``: the visual hull of our silhouettes.
- ``poisson``: screened Poisson (Kazhdan and Hoppe 2013, by Open3D) on the points and normals of our depth maps; seconds
  are without those of the depth maps.
- ``openmvs``: densify, reconstruct, refine, if the folder of its programs is given; seconds are its own.

The face is scored by the distances of the true face region to each surface. A program that the machine lacks, or that
finds no surface, is listed as left out.
"""

# pyright: reportMissingImports=false
# Open3D is of the dependency group `peers`: `uv sync --group peers`.

import importlib.util
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated

import numpy as np

from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull import hull_extent
from pipeline.reconstruct import reconstruct
from pipeline.segmentation.segment import segment
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stereo.crops import Crop, make_crops
from pipeline.stereo.depth_map import DepthMap, points_world
from pipeline.stereo.estimate import PIXEL_MM, estimate_depth
from rig.errors import EigenheadError
from rig.mesh import Mesh
from rig.progress import discard_progress
from rig.render.renderer import Renderer
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.detail import Known, every_level, read_known, surface_error
from tests.laboratory.experiments.peers.openmvs import PeerFailed, programs_in, surface_by_openmvs
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by
from tests.laboratory.experiments.surface.visible_surface import score_visible
from tests.laboratory.experiments.visual_hull import visual_hull

POISSON_DEPTH = 9  # of its octree: cells of 1 to 1.5 mm about a bust
SURE_MM = 1.0  # points with a larger deviation stay out
COLUMNS = (
    "recall_all_within_2mm", "recall_head_within_2mm", "recall_hair_within_2mm", "recall_clothes_within_2mm",
    "recall_all_median", "precision_head_within_2mm", "precision_hair_within_2mm", "face_median_mm", "face_mean_mm",
    "face_p95_mm", "closed", "cpu_s",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Shown:
    """Holds a subject and what surfaces are made from; silhouettes and depth maps are computed when first used."""

    known: Known
    model: HeadModel
    renderer: Renderer

    @cached_property
    def silhouettes(self) -> dict[str, Silhouette]:
        """Computes the silhouettes of the capture, by camera."""
        return segment(self.known.capture, self.known.rig, report=discard_progress)

    def crops(self) -> list[Crop]:
        """Cuts out the subject in the photographs, undistorted, as the depth maps show it."""
        at_world = hull_extent(self.silhouettes, self.known.rig)[0]
        images = self.known.capture.images
        return make_crops(images, self.silhouettes, self.known.rig, pixel_mm=PIXEL_MM, at_world=at_world)

    @cached_property
    def depth_maps(self) -> tuple[DepthMap, ...]:
        """Computes the depth maps of the capture, with the head fitted at the level ``photo``."""
        known = self.known
        head = every_level(known.capture, known.rig, self.model, ("photo",), self.renderer)["photo"].mesh()
        return estimate_depth(known.capture.images, self.silhouettes, known.rig, head, report=discard_progress)


def surfaces(
    model: HeadModel,
    captures: Mapping[str, Path],
    *,
    renderer: Renderer,
    bench: Bench,
    openmvs: Annotated[Path | None, "the folder of that peer's programs"] = None,
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``; a figure is
    ``<capture>_<peer>_<quantity>``.

    ``model``: fitted. ``captures``: folders with a truth beside them, by name. ``renderer``: for the fit. ``openmvs``:
    folder of the programs of OpenMVS; None leaves it out.

    Raises InputError if ``openmvs`` lacks a program.
    """
    programs = None if openmvs is None else programs_in(openmvs)
    makers: dict[str, Callable[[Shown], tuple[Mesh, float]]] = {"eigenhead": ours, "hull": hull}
    left_out = {}
    if importlib.util.find_spec("open3d") is None:
        left_out["poisson"] = "Open3D is not installed: run `uv sync --group peers`"
    else:
        makers["poisson"] = poisson
    if programs is None:
        left_out["openmvs"] = "name the folder of its programs with --openmvs"
    else:
        makers["openmvs"] = partial(by_openmvs, programs=programs)
    rows: list[Row] = []
    for i, (name, path) in enumerate(captures.items()):
        shown = Shown(read_known(path), model, renderer)
        for j, (peer, make) in enumerate(makers.items()):
            bench.report(f"{name} {peer}", (i + j / len(makers)) / len(captures))
            records = bench.records(f"surfaces-{peer}", key_of(model.sha256, Settings(), str(openmvs)))
            rows.append(
                {"name": name, "peer": peer, **records.row(name, partial(peer_row, shown.known, partial(make, shown)))}
            )
        rows += [{"name": name, "peer": peer, "left_out": why} for peer, why in left_out.items()]
    return {"figures": figures(rows), "rows": rows, "markdown": as_markdown(rows)}


def peer_row(known: Known, make: Callable[[], tuple[Mesh, float]]) -> Row:
    """Returns the scores of a surface, or why there is none."""
    try:
        mesh, seconds = make()
    except EigenheadError as failed:
        return {"left_out": str(failed)}
    face = {f"face_{name}": value for name, value in surface_error(known, mesh).items()}
    flat = {**score_visible(known.visible, mesh).flat(), **face, "cpu_s": seconds}
    return {name: flat[name] for name in COLUMNS if name in flat}


def ours(shown: Shown) -> tuple[Mesh, float]:
    """Makes the bust of this project. Returns it with the processor seconds of the whole job. Raises PeerFailed without
    a bust."""
    before, known = time.process_time(), shown.known
    found = reconstruct(ReconstructionContext(known.capture, known.rig, shown.model, Settings(), shown.renderer))
    if found.bust is None:
        raise PeerFailed("eigenhead", "no bust")
    return found.bust.mesh_world, time.process_time() - before


def hull(shown: Shown) -> tuple[Mesh, float]:
    """Makes the visual hull. Returns it with its processor seconds, silhouettes excluded."""
    silhouettes, before = shown.silhouettes, time.process_time()
    return visual_hull(silhouettes, shown.known.rig), time.process_time() - before


def poisson(shown: Shown) -> tuple[Mesh, float]:
    """Makes a surface from the depth maps by Open3D's screened Poisson reconstruction. Returns it with its processor
    seconds, depth maps excluded."""
    import open3d

    maps, before = shown.depth_maps, time.process_time()
    sure = [(each.deviation_mm < SURE_MM)[each.known] for each in maps]
    cloud = open3d.geometry.PointCloud()
    for target, values in (
        ("points", [points_world(each) for each in maps]),
        ("normals", [each.normal[each.known].astype(float) for each in maps]),
    ):
        kept = np.concatenate([value[good] for value, good in zip(values, sure, strict=True)])
        setattr(cloud, target, open3d.utility.Vector3dVector(kept))
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=POISSON_DEPTH)
    found = Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int32))
    return found, time.process_time() - before


def by_openmvs(shown: Shown, *, programs: Mapping[str, Path]) -> tuple[Mesh, float]:
    """Makes a surface from the photographs by OpenMVS, starting from the visual hull. Returns it with its processor
    seconds."""
    with tempfile.TemporaryDirectory(prefix="openmvs-") as folder:
        body = visual_hull(shown.silhouettes, shown.known.rig)
        return surface_by_openmvs(shown.crops(), body, programs, Path(folder))


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Returns the numbers of all rows by name: capture, surface and column joined."""
    return means_by([row | {"surface": f"{row['name']}_{row['peer']}"} for row in rows], "surface")


def as_markdown(rows: Sequence[Row]) -> str:
    """Returns a Markdown table with a row for each surface; what is left out is listed below with its reason."""
    scored = [row for row in rows if "left_out" not in row]
    cells = [[row["name"], row["peer"], *(row.get(column) for column in COLUMNS)] for row in scored]
    header = ("capture", "surface", *(column.replace("_", " ") for column in COLUMNS))
    left = [f"{row['name']}, {row['peer']}: left out ({row['left_out']})." for row in rows if "left_out" in row]
    return markdown.table(header, cells) + "".join(f"\n{line}\n" for line in left)
