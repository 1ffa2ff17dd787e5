"""Measures how much of the skin's relief is real, without a truth: what two halves of the views do not both show is
noise.

Every capture is reconstructed three times by the default job: from all its views, and from two halves without a common
view. Where the bust of all views is skin that both halves measured, the heights of the halves' busts are compared.
Relief is the deviation of a height from its own mean within 3 mm. Each half has half of the evidence and its own pairs
of views, so that its noise is larger than that of the whole capture.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline import reconstruct as composition
from pipeline.fusion.fusion import BustSurface
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.part_labels.codes import Part
from pipeline.reconstruct import reconstruct
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.formats.captures.capture_folder import read_capture
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.people.view_subsets import azimuths_deg
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.local_means import means_within

SMOOTH_MM = 3.0  # radius of the mean that relief departs from
MAX_HEIGHT_MM = 5.0  # a surface farther off is another one
MIN_PLACES = 500  # of skin, for a figure
MIN_AROUND = 6  # places within SMOOTH_MM, for a mean


@dataclass(frozen=True, slots=True, eq=False)
class Relief:
    """Holds the relief (mm) of two surfaces at the same points."""

    first_mm: Float[np.ndarray, " n"]
    second_mm: Float[np.ndarray, " n"]

    def figures(self) -> dict[str, float]:
        """Compares both surfaces. ``unrepeated_rms_mm`` is one surface's part of the difference, the root of half of
        its mean square; ``unrepeated_median_mm`` its median; ``repeated_rms_mm`` the relief that both show."""
        off = np.abs(self.first_mm - self.second_mm) / np.sqrt(2.0)
        return {
            "unrepeated_rms_mm": float(np.sqrt(np.mean(off**2))),
            "unrepeated_median_mm": float(np.median(off)),
            "unrepeated_p95_mm": float(np.percentile(off, 95)),
            "repeated_rms_mm": float(np.sqrt(max(np.mean(self.first_mm * self.second_mm), 0.0))),
            "places": float(len(off)),
        }


def relief(model: HeadModel, captures: Mapping[str, Path], *, renderer: Renderer, bench: Bench) -> Outcome:
    """Runs the experiment on every capture; a figure is ``<capture>_<quantity>``.

    Args:
        model: fitted.
        captures: folders, by name.
        renderer: for the jobs.

    Raises:
        EigenheadError: a half has too few views for a head, or no skin in common with the other.
    """
    records = bench.records("relief", key_of(model.sha256, Settings(), *CONTOUR, composition))
    rows: list[Row] = []
    for done, (name, path) in enumerate(captures.items()):
        bench.report(name, done / len(captures))
        rows.append({"name": name} | records.row(str(path.resolve()), lambda path=path: _row(path, model, renderer)))
    figures = {f"{row['name']}_{key}": row[key] for row in rows for key in row if key not in ("name", "halves")}
    columns = ("unrepeated_rms_mm", "unrepeated_median_mm", "unrepeated_p95_mm", "repeated_rms_mm", "places")
    header = ("capture", "relief not repeated, RMS, mm", "median", "p95", "repeated, RMS", "places")
    table = [[row["name"], *(row[column] for column in columns)] for row in rows]
    return {"figures": figures, "rows": rows, "markdown": markdown.table(header, table)}


def _row(path: Path, model: HeadModel, renderer: Renderer) -> Row:
    capture, rig = read_capture(path)
    whole = _reconstructed(capture, rig, rig.names, model, renderer)
    halves = split_views(rig, whole.head.fit.world_from_head)
    busts = [_bust(_reconstructed(capture, rig, half, model, renderer)) for half in halves]
    found = compare_relief(_bust(whole), *busts)
    if len(found.first_mm) < MIN_PLACES:
        raise EigenheadError(f"{path.name}: {len(found.first_mm)} places of skin in common, {MIN_PLACES} are needed")
    return found.figures() | {"halves": [list(half) for half in halves]}


def split_views(rig: Rig, world_from_head: Similarity) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the names of every second camera around the head, and of the others."""
    around = [rig.names[k] for k in np.argsort(azimuths_deg(rig, world_from_head), kind="stable")]
    return tuple(around[::2]), tuple(around[1::2])


def _reconstructed(
    capture: Capture, rig: Rig, names: tuple[str, ...], model: HeadModel, renderer: Renderer
) -> Reconstruction:
    def selected(by_camera: Mapping) -> dict:
        return {name: value for name, value in by_camera.items() if name in names}

    seen = replace(
        capture,
        images=selected(capture.images),
        backgrounds=selected(capture.backgrounds),
        masks=selected(capture.masks),
        soft_masks=selected(capture.soft_masks),
        features=capture.features if names == rig.names else {},  # clicked in two views, of which a half has one
    )
    return reconstruct(ReconstructionContext(seen, rig.subset(names), model, Settings(), renderer))


def _bust(found: Reconstruction) -> BustSurface:
    if found.bust is None:
        raise EigenheadError(f"no bust ({'; '.join(str(warning) for warning in found.warnings)})")
    return found.bust.surface


def compare_relief(whole: BustSurface, first: BustSurface, second: BustSurface) -> Relief:
    """Compares two surfaces' relief over the skin of ``whole`` that both measured."""
    skin = (whole.part == Part.SKIN) & whole.seen
    places, normals = whole.mesh_world.vertices[skin], whole.mesh_world.normals()[skin]
    one, two = heights_mm(places, normals, first), heights_mm(places, normals, second)
    both = np.isfinite(one) & np.isfinite(two)
    near = means_within(places[both], SMOOTH_MM)
    known = np.diff(near.indptr) >= MIN_AROUND
    return Relief(*((height[both] - near @ height[both])[known] for height in (one, two)))


def heights_mm(
    places: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], bust: BustSurface
) -> Float[np.ndarray, " n"]:
    """Returns how far the measured surface lies above each point along its normal; NaN where there is none."""
    mesh: Mesh = bust.mesh_world
    faces = mesh.faces[bust.seen[mesh.faces].all(axis=1)]
    hit = SurfaceIndex(mesh.vertices, faces, 1.0).closest(places, facing=normals)
    slant = (hit.normals * normals).sum(axis=1)
    off = ((hit.points - places) * hit.normals).sum(axis=1)
    # Beyond the rim of what is measured the nearest point lies aside, and not along the triangle's normal.
    aside = np.sqrt(np.maximum(hit.distances**2 - off**2, 0.0))
    return np.where((slant > 0.5) & (aside < 0.5) & (np.abs(off) < MAX_HEIGHT_MM * slant), off / slant, np.nan)
