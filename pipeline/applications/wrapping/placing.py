"""Places a scan where the model's mean head lies: by its face, found on renders, or by marked landmarks."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.applications.templates.likeness import SurfaceMarks
from pipeline.applications.templates.placement import Surface, outward, place_by_landmarks
from pipeline.applications.wrapping.scan import RawScan
from pipeline.applications.wrapping.sighting import ScanSighting, nearest_axis, sight_scan, unit_of
from pipeline.faces.landmark_map import landmark_map
from pipeline.faces.networks import load_networks
from pipeline.faces.points import RIGHT_EYE_OUTLINE, point_table
from pipeline.geometry.registration.procrustes import procrustes
from pipeline.head_model.model import HeadModel
from rig.geometry import Similarity
from rig.mesh import vertex_normals
from rig.render.renderer import Renderer

# Deviation of a found point, an axis: the network errs by 1 to 2 mm, but all points of a region together. With 2 mm the
# landmarks of a known head came 2.0 mm off, with 10 mm 1.0 (the laboratory's `wrap`, draw-b): the surface knows better.
MARK_MM = 10.0
LID_MM = (20.0, 0.5, 3.0)  # the same of the eyes' network along x, y, z of the head: it tells how high a lid's edge is
EDGES = np.array([3, 4, 5, 11, 12, 13])  # of ``lids_mm``, an eye: middles of the lids; near corners they end early
LIDS = np.array(RIGHT_EYE_OUTLINE)[EDGES]
LIDS = np.r_[LIDS, point_table().mirror_images[LIDS]]  # of the 468 points, right and left


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """Holds a scan with its unit and axes, and how the mean head lies on it."""

    scan: RawScan  # turned over where its triangles looked inwards
    turned_over: bool
    unit: str | None  # None where no unit makes it a head, and a mean adult's size was assumed
    mm_per_unit: float
    head_from_scan: Similarity  # into the frame and scale of the model's mean head
    marks: SurfaceMarks  # in that frame
    views: int  # renders that show the face; 0 where landmarks placed it

    @property
    def up(self) -> str:
        """Returns the axis of the scan nearest to the head's up, as "+y"."""
        return nearest_axis(self.head_from_scan.rotation[1])

    @property
    def front(self) -> str:
        """Returns the axis of the scan nearest to where the face looks."""
        return nearest_axis(self.head_from_scan.rotation[2])

    def surface(self) -> Surface:
        """Returns the scan's surface in the mean head's frame and scale."""
        mesh = self.scan.mesh
        vertices = self.head_from_scan.apply(mesh.vertices)
        return Surface(vertices, mesh.faces, vertex_normals(vertices, mesh.faces))


def place_scan(
    scan: RawScan, model: HeadModel, landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None
) -> PlacedScan:
    """Places a scan by the face that is found on it, or by landmarks in the scan's own frame. Raises InputError if no
    face is found, or too few landmarks are named."""
    if not landmarks:
        with Renderer.create() as renderer:
            return place_on_face(model, sight_scan(scan, load_networks(), renderer))
    head_from_scan = place_by_landmarks(model, landmarks, scan.name)
    unit, factor = unit_of(1.0 / head_from_scan.scale)
    inward = not np.array_equal(outward(scan.mesh.vertices, scan.mesh.faces).faces, scan.mesh.faces)
    known = {name: head_from_scan.apply(point) for name, point in landmarks.items()}
    return PlacedScan(
        scan=scan.turned_over() if inward else scan,
        turned_over=inward,
        unit=unit,
        mm_per_unit=factor,
        head_from_scan=head_from_scan,
        marks=SurfaceMarks.of_landmarks(model, known),
        views=0,
    )


def place_on_face(model: HeadModel, sighting: ScanSighting) -> PlacedScan:
    """Places a scan by its face, whatever that face's size: its points become marks, the lids' edges among them."""
    places = landmark_map(model)
    which, mean = np.flatnonzero(~places.slides), model.vertices(np.zeros(0))
    found = sighting.face.points_world[which]
    weights = 1.0 / (places.deviation_mm[which] ** 2).sum(axis=1)
    head_from_mm = procrustes(found, places.expected(mean)[which], weights)
    points, deviation = places.points(mean), np.full(places.rows.shape, MARK_MM)
    points[which] = head_from_mm.apply(found) - places.offset_mm[which]
    if sighting.lids_mm is not None:
        points[LIDS], deviation[LIDS] = head_from_mm.apply(sighting.lids_mm[np.r_[EDGES, EDGES + 16]]), LID_MM
    mm_from_scan = Similarity(sighting.mm_per_unit, np.eye(3), np.zeros(3))
    return PlacedScan(
        scan=sighting.scan,
        turned_over=sighting.turned_over,
        unit=sighting.unit,
        mm_per_unit=sighting.mm_per_unit,
        head_from_scan=head_from_mm @ mm_from_scan,
        marks=SurfaceMarks(places.rows[which], places.weights[which], points[which], deviation[which]),
        views=len(sighting.face.detections),
    )
