"""Composes the wrapping of a scan: placed by its face, fitted, drawn, measured."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.applications.templates.likeness import CANDIDATES, Likeness
from pipeline.applications.templates.placement import Surface
from pipeline.applications.templates.template_file import Template
from pipeline.applications.wrapping.fitting import fit_template
from pipeline.applications.wrapping.placing import PlacedScan, place_scan
from pipeline.applications.wrapping.scan import RawScan
from pipeline.geometry.surface_index import Hits, SurfaceIndex
from pipeline.head_model.model import HeadModel
from rig.errors import InputError
from rig.mesh import vertex_normals
from rig.messages.message import compose
from rig.progress import Progress

MIN_COVERED = 0.5  # of the model's face region: less is no face
LIKE_MM = 3.0  # median distance of the fitted face from the scan: more is another thing than a head
SCAN_POINTS = 20_000  # of the scan, whose distance from the template is measured


@dataclass(frozen=True, slots=True, eq=False)
class Wrapped:
    """Holds a template on a scan, in the scan's own frame and unit."""

    template: Template
    placed: PlacedScan
    vertices: Float[np.ndarray, "t 3"]
    covered: Bool[np.ndarray, " t"]  # vertices that lie on the scan; others continue the shape where it has nothing
    distance_mm: Float[np.ndarray, " t"]  # of every vertex from the scan's surface
    scan_distance_mm: Float[np.ndarray, " n"]  # of points of the scan from the template, where the template is
    likeness: Likeness
    index: SurfaceIndex  # of the scan, own frame

    def hits(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Hits:
        """Returns the closest places of the scan that face the same way."""
        return _closest(self.index, points, normals, self.placed.mm_per_unit)

    def figures(self) -> dict[str, float]:
        """Returns the figures of the wrapping by name, for printing."""
        on = self.distance_mm[self.covered]
        return {
            "vertices": float(len(self.vertices)),
            "covered_share": float(self.covered.mean()),
            "median_mm": float(np.median(on)),
            "p95_mm": float(np.percentile(on, 95)),
            "all_median_mm": float(np.median(self.distance_mm)),
            "scan_median_mm": float(np.median(self.scan_distance_mm)),
            "scan_p95_mm": float(np.percentile(self.scan_distance_mm, 95)),
        }


def wrap(
    scan: RawScan,
    template: Template,
    model: HeadModel,
    *,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    report: Progress,
) -> Wrapped:
    """Gives a scan the vertex order of a template.

    Args:
        scan: in any unit and orientation.
        template: registered to ``model``.
        model: the head model.
        landmarks: in the scan's frame; None finds the face on renders.
        report: progress.

    Raises InputError if the scan shows no face, or is no head."""
    report("finding the face", 0.0)
    placed = place_scan(scan, model, landmarks)
    surface = placed.surface()
    fitted = fit_template(template, model, surface, placed.marks, report)
    _check(fitted.likeness, scan.name)
    report("measuring", 0.9)
    vertices = placed.head_from_scan.inverse().apply(fitted.vertices)
    mesh, triangles = placed.scan.mesh, template.mesh.triangles()
    index = SurfaceIndex(mesh.vertices, mesh.faces, 2.0 / placed.mm_per_unit)
    hits = _closest(index, vertices, vertex_normals(vertices, triangles), placed.mm_per_unit)
    return Wrapped(
        template=template,
        placed=placed,
        vertices=vertices,
        covered=fitted.met,
        distance_mm=hits.distances * placed.mm_per_unit,
        scan_distance_mm=_scan_distances(placed, vertices, triangles, fitted.met),
        likeness=fitted.likeness,
        index=index,
    )


def residual_colours(distance_mm: Float[np.ndarray, " t"], covered: Bool[np.ndarray, " t"]) -> UInt8[np.ndarray, "t 3"]:
    """Returns colours of distances: white at 0, yellow at 0.5 mm, red from 1 mm on; grey where the scan has nothing."""
    share = np.clip(distance_mm, 0.0, 1.0)
    colours = np.stack(
        [np.ones_like(share), np.clip(2.0 - 2.0 * share, 0, 1), np.clip(1.0 - 2.0 * share, 0, 1)], axis=1
    )
    out = np.rint(235.0 * colours).astype(np.uint8)
    out[~covered] = (140, 140, 150)
    return out


def _closest(
    index: SurfaceIndex, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], mm_per_unit: float
) -> Hits:
    return index.closest(points, CANDIDATES, facing=normals, facing_mm=10.0 / mm_per_unit)


def _scan_distances(
    placed: PlacedScan,
    vertices: Float[np.ndarray, "t 3"],
    triangles: Int[np.ndarray, "f 3"],
    covered: Bool[np.ndarray, " t"],
) -> Float[np.ndarray, " n"]:
    """Returns the distances (mm) of points of the scan from the template, for those whose closest place lies in a
    covered triangle."""
    mesh = placed.scan.mesh
    rows = np.arange(0, len(mesh.vertices), max(1, len(mesh.vertices) // SCAN_POINTS))
    normals = vertex_normals(mesh.vertices, mesh.faces)[rows]
    index = SurfaceIndex(vertices, triangles, 2.0 / placed.mm_per_unit)
    hits = _closest(index, mesh.vertices[rows], normals, placed.mm_per_unit)
    return hits.distances[covered[triangles[hits.triangles]].all(axis=1)] * placed.mm_per_unit


def _check(like: Likeness, name: str) -> None:
    met, area = np.isfinite(like.distances), np.where(like.in_face, like.areas, 0.0)
    share = float(area[met].sum() / area.sum())
    if share < MIN_COVERED:
        raise InputError(name, [compose("scan-shows-little", share=share, needed=MIN_COVERED)])
    off_mm = float(np.median(like.distances[met & like.in_face]))
    if off_mm > LIKE_MM:
        raise InputError(name, [compose("scan-no-head", off_mm=off_mm)])


def surface_in_head(wrapped: Wrapped) -> tuple[Surface, Surface]:
    """Returns scan and template in the frame and scale of the mean head, for drawing."""
    place = wrapped.placed.head_from_scan
    vertices, faces = place.apply(wrapped.vertices), wrapped.template.mesh.triangles()
    return wrapped.placed.surface(), Surface(vertices, faces, vertex_normals(vertices, faces))
