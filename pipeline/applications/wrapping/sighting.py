"""Finds the face of a scan on renders of it, whatever its unit and its axes.

The scan is drawn from all sides until one picture shows a face (the finder takes it in any roll). Its points are lifted
onto the scan; their size tells the unit, their order in space the axes. Then the scan is drawn from seven directions in
front of that face, as photographs of a rig, and the face is found in these as in any capture.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.wrapping.scan import RawScan
from pipeline.faces.detection import CERTAIN_SCORE, FaceDetection, find_faces
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import FaceNetworks
from pipeline.faces.points import point_table
from pipeline.faces.subject import find_subject
from pipeline.geometry.registration.procrustes import procrustes
from pipeline.multiview.triangulation import NoPoint, triangulate_many
from rig.camera import Camera, Intrinsics
from rig.errors import InputError
from rig.geometry import Similarity, look_at
from rig.image import ImageRgb
from rig.mesh import Mesh, face_normals
from rig.messages.message import compose
from rig.render.colour import HEADLIGHT, UNLIT, Light
from rig.render.renderer import Renderer
from rig.rig import Rig

UNITS_MM = {"mm": 1.0, "cm": 10.0, "in": 25.4, "dm": 100.0, "m": 1000.0}
SIZE_RANGE = 0.72, 1.4  # of the mean adult's face: children's to large ones, and narrower than the steps between units
SEARCH_PX, SEARCH_RADIUS = 640, 150.0  # of the pictures from all sides; there the scan has this radius
OUTLYING = 0.5  # percent of the triangles at either end of an axis that a stray part may have
FRONT_PX, FRONT_MM, FRONT_SHOWN_MM = 768, 800.0, 330.0  # of the pictures before the face: size, distance, breadth
FRONT_DEG = ((0, 0), (-22, 0), (22, 0), (-45, 0), (45, 0), (0, 20), (0, -20))  # to the subject's left, and up
BACKGROUND = (120, 125, 130)
MIN_LIFTED = 200  # of the 468 points that must hit the scan
ROUNDS = 3  # of a mean face fitted to points that were lifted, some past the scan's edge
NEAR_MM = 8.0  # of a mean adult: a lifted point that differs by this weighs a quarter


@dataclass(frozen=True, slots=True, eq=False)
class ScanSighting:
    """Holds the face found on a scan."""

    scan: RawScan  # turned over where its triangles looked inwards
    unit: str | None  # of ``UNITS_MM``; None where no unit makes it a head, and an adult's size was assumed
    mm_per_unit: float
    turned_over: bool
    face: MatchedFaces  # in mm: the scan's own axes and origin, times ``mm_per_unit``
    lids_mm: Float[np.ndarray, "32 3"] | None  # edges of the lids, as ``FaceDetection.lids_px``; None: not found


@dataclass(frozen=True, slots=True, eq=False)
class _Glance:
    """Holds a face in one picture, lifted onto the scan (its own unit)."""

    detection: FaceDetection
    scan_from_face: Similarity  # of a mean adult's points, mm
    from_outside: bool  # a mask seen from behind shows a face, too, whose nose is farthest away


def sight_scan(scan: RawScan, networks: FaceNetworks, renderer: Renderer) -> ScanSighting:
    """Finds the face of a scan, its unit and its axes. Raises InputError if no picture shows a face."""
    mesh = scan.drawable()
    lights = (UNLIT, HEADLIGHT) if scan.is_coloured else (HEADLIGHT,)
    glance = next((found for light in lights if (found := _search(mesh, light, networks, renderer))), None)
    if glance is None:
        raise InputError(scan.name, [compose("scan-no-face")])
    unit, factor = unit_of(glance.scan_from_face.scale)
    inward = _looks_inwards(mesh, glance.scan_from_face)
    if inward:
        scan, mesh = scan.turned_over(), Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.colours)
    large = Mesh(mesh.vertices * factor, mesh.faces, mesh.colours)
    placed = replace(
        glance.scan_from_face,
        scale=glance.scan_from_face.scale * factor,
        translation=glance.scan_from_face.translation * factor,
    )
    rig = front_rig(placed)
    matched = None
    for light in lights:
        subject = find_subject(_pictures(rig, large, light, renderer), rig, networks, eye_distance_mm=None)
        if subject.matched is not None and len(subject.matched.detections) > 1:
            matched = subject.matched
            break
    if matched is None:
        raise InputError(scan.name, [compose("scan-no-face")])
    return ScanSighting(scan, unit, factor, inward, matched, _lids(matched, rig))


def unit_of(scale: float) -> tuple[str | None, float]:
    """Returns the unit and its millimetres in which a face has a head's size, from its size in the scan's unit by a
    mean adult's in mm. Returns None, and what makes it a mean adult, if no unit does."""
    for unit, factor in UNITS_MM.items():
        if SIZE_RANGE[0] < scale * factor < SIZE_RANGE[1]:
            return unit, factor
    return None, 1.0 / scale


def front_rig(world_from_face: Similarity) -> Rig:
    """Returns cameras before a face (mm), which look at its middle."""
    turn, middle = world_from_face.rotation, world_from_face.translation
    lens = _lens(FRONT_PX, FRONT_PX * FRONT_MM / FRONT_SHOWN_MM)
    cameras = []
    for number, (left_deg, up_deg) in enumerate(FRONT_DEG):
        left, up = np.radians([left_deg, up_deg])
        towards = turn @ np.array([np.cos(up) * np.sin(left), np.sin(up), np.cos(up) * np.cos(left)])
        cameras.append(Camera(f"front{number}", lens, look_at(middle + FRONT_MM * towards, middle, turn[:, 1])))
    return Rig(tuple(cameras))


def _lens(size: int, focal_px: float) -> Intrinsics:
    return Intrinsics(size, size, focal_px, focal_px, (size - 1) / 2, (size - 1) / 2)


def _search(mesh: Mesh, light: Light, networks: FaceNetworks, renderer: Renderer) -> _Glance | None:
    """Returns the best face of the pictures from all sides: first those along the axes, then, unless one of these is
    beyond doubt, those between."""
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    low, high = np.percentile(centres, [OUTLYING, 100.0 - OUTLYING], axis=0)
    middle, factor = (low + high) / 2, SEARCH_RADIUS / max(float(np.linalg.norm(high - low)) / 2, 1e-12)
    small = Mesh((mesh.vertices - middle) * factor, mesh.faces, mesh.colours)
    small_from_scan = Similarity(factor, np.eye(3), -factor * middle)
    best: _Glance | None = None
    for rig in _round_rigs():
        pictures, depths = _pictures(rig, small, light, renderer), renderer.depth(rig, small.vertices, small.faces)
        for camera in rig:
            for face in find_faces(pictures[camera.name], networks)[:1]:
                glance = _lifted(face, camera, depths[camera.name], small_from_scan)
                if glance and glance.from_outside and (best is None or face.score > best.detection.score):
                    best = glance
        if best is not None and best.detection.score >= CERTAIN_SCORE:
            return best
    return best


def _round_rigs() -> Iterator[Rig]:
    """Returns cameras that look at the origin along the axes, then along the diagonals."""
    focal = 0.5 * SEARCH_PX * 6.0 * SEARCH_RADIUS / (1.02 * SEARCH_RADIUS)
    directions = [np.array(d, float) for d in product((-1, 0, 1), repeat=3) if any(d)]
    for diagonal in (False, True):
        cameras = []
        for direction in directions:
            if (np.count_nonzero(direction) > 1) != diagonal:
                continue
            eye = 6.0 * SEARCH_RADIUS * direction / np.linalg.norm(direction)
            up = np.array([0.0, 1.0, 0.0]) if not (direction[0] == direction[2] == 0) else np.array([0.0, 0.0, 1.0])
            name = "".join("-0+"[int(step) + 1] for step in direction)
            cameras.append(Camera(name, _lens(SEARCH_PX, focal), look_at(eye, np.zeros(3), up)))
        yield Rig(tuple(cameras))


def _pictures(rig: Rig, mesh: Mesh, light: Light, renderer: Renderer) -> dict[str, ImageRgb]:
    drawn = renderer.colour(rig, mesh, light=light)
    return {name: _before_grey(image) for name, image in drawn.items()}


def _before_grey(image: np.ndarray) -> ImageRgb:
    share = image[..., 3:].astype(float) / 255.0
    return np.rint(share * image[..., :3] + (1.0 - share) * np.array(BACKGROUND)).astype(np.uint8)


def _lifted(
    face: FaceDetection, camera: Camera, depth: Float[np.ndarray, "h w"], small_from_scan: Similarity
) -> _Glance | None:
    """Lifts the points of a face onto the scan. Returns None if too few of them lie on it."""
    columns, rows = np.clip(np.rint(face.landmarks_px).astype(int), 0, SEARCH_PX - 1).T
    away = depth[rows, columns].astype(float)
    hit = np.isfinite(away)
    if np.count_nonzero(hit) < MIN_LIFTED:
        return None
    rays = np.column_stack([camera.undistort(face.landmarks_px[hit]), np.ones(np.count_nonzero(hit))])
    points = camera.camera_from_world.inverse().apply(rays * away[hit, None])
    shape, weights = point_table().shape_mm[hit], np.ones(len(points))
    placed = procrustes(shape, points, weights)
    for _ in range(ROUNDS):
        off = np.linalg.norm(placed.apply(shape) - points, axis=1) / placed.scale
        weights = (1.0 + (off / NEAR_MM) ** 2) ** -2
        placed = procrustes(shape, points, weights)
    bulges = np.corrcoef(shape[:, 2], away[hit])[0, 1] < 0.0  # what stands out of the face is nearer
    outside = float(placed.rotation[:, 2] @ camera.axis_world) < 0.0 and bool(bulges)
    return _Glance(face, small_from_scan.inverse() @ placed, outside)


def _looks_inwards(mesh: Mesh, scan_from_face: Similarity) -> bool:
    """Tells whether the triangles in front of the face look into the head."""
    face_from_scan = scan_from_face.inverse()
    middles = face_from_scan.apply(mesh.vertices[mesh.faces].mean(axis=1))
    shape = point_table().shape_mm
    inside: Bool[np.ndarray, " f"] = ((middles > shape.min(axis=0)) & (middles < shape.max(axis=0) + 30.0)).all(axis=1)
    ahead = face_normals(mesh.vertices, mesh.faces[inside]) @ scan_from_face.rotation[:, 2]
    return bool(ahead.sum() < 0.0)


def nearest_axis(direction: Float[np.ndarray, " 3"]) -> str:
    """Returns the axis nearest to a direction, as "+y"."""
    largest = int(np.abs(direction).argmax())
    return ("+" if direction[largest] > 0 else "-") + "xyz"[largest]


def _lids(face: MatchedFaces, rig: Rig) -> Float[np.ndarray, "32 3"] | None:
    """Triangulates the edges of the lids as the eyes' network sees them, also those of closed eyes."""
    seen = {name: found.lids_px for name, found in face.detections.items() if found.lids_px is not None}
    if len(seen) < 2:
        return None
    pixels = np.stack([*seen.values()])
    try:
        return triangulate_many(pixels, [rig[name] for name in seen], np.ones(pixels.shape[:2])).positions_world
    except NoPoint:
        return None
