"""Wraps a scan in four steps: it is placed by its detected face, the head model is fitted, the template is deformed,
and distances are measured.

The face is detected in rendered pictures, for any unit and axes of the scan. The scan is rendered from all sides until
one picture shows a face; the detector accepts any roll of the picture. The detected face points are projected onto the
scan; their size determines the unit, and their arrangement the axes. The placed scan is rendered from seven sides in
front of that face, like photographs of a rig, and the face is detected and matched in these pictures.

Next, the head model is fitted to the scan, as in a template's registration (``templates``). Last, the template's
vertices are deformed as in ``geometry.registration.nonrigid``, with exact closest points on the scan's triangles."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from pipeline.applications.templates.likeness import (
    CANDIDATES,
    Likeness,
    MetSurface,
    Stage,
    SurfaceMarks,
    fit_model_to_mesh,
)
from pipeline.applications.templates.placement import Surface, outward, place_by_landmarks
from pipeline.applications.templates.registration import components, weld
from pipeline.applications.templates.template_file import Template
from pipeline.applications.wrapping.scan import RawScan
from pipeline.faces.detection import CERTAIN_SCORE, FaceDetection, find_faces
from pipeline.faces.landmark_map import landmark_map
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import FaceNetworks, load_networks
from pipeline.faces.points import RIGHT_EYE_OUTLINE, point_table
from pipeline.faces.subject import find_subject
from pipeline.fusion.untangling import topology_of, untangle
from pipeline.geometry.registration.nonrigid import draw_to_matches
from pipeline.geometry.registration.rigid import procrustes
from pipeline.geometry.surface_index import Hits, SurfaceIndex
from pipeline.head_model.model import HeadModel, with_expressions
from pipeline.multiview.triangulation import NoPoint, triangulate_many
from rig.camera import Camera, Intrinsics
from rig.errors import InputError
from rig.geometry import Similarity, look_at
from rig.image import ImageRgb
from rig.mesh import Mesh, face_normals, vertex_normals
from rig.messages.message import compose
from rig.progress import Progress
from rig.render.renderer import HEADLIGHT, UNLIT, Light, Renderer
from rig.rig import Rig

# Deviation of a found point, an axis: the network errs by 1 to 2 mm, but all points of a region together. With 2 mm the
# landmarks of a known head came 2.0 mm off, with 10 mm 1.0 (the laboratory's `wrap`, draw-b): the surface knows better.
MARK_MM = 10.0
LID_MM = (20.0, 0.5, 3.0)  # the same of the eyes' network along x, y, z of the head: it tells how high a lid's edge is
EDGES = np.array([3, 4, 5, 11, 12, 13])  # of ``lids_mm``, an eye: middles of the lids; near corners they end early
LIDS = np.array(RIGHT_EYE_OUTLINE)[EDGES]
LIDS = np.r_[LIDS, point_table().mirror_images[LIDS]]  # of the 468 points, right and left
# Of each step of the drawing, and how far off (mm) a place of the scan still draws: from the fit's own error to less
# than vertices lie apart.
STIFFNESS = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.03, 0.01, 0.01)
REACH_MM = (6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 2.0, 2.0, 2.0, 2.0)
# The prior stays stronger than for a template: the template's own vertices follow the scan to the end.
STAGES = (
    Stage(5, 10, 25.0, 12.0, 2.0),
    Stage(5, 40, 15.0, 12.0, 1.5),
    Stage(6, None, 10.0, 12.0, 1.0),
    Stage(6, None, 5.0, 0.0, 0.5),
)
CARRYING = 0.02  # stiffness of the template's own shape while the model's head carries it
FOLLOWING = 0.1  # weight there of what follows the skin outside of the face, shoulders, beside 1 of skin
FACE_MM = 20.0  # of the model's face: what is no skin of the template there lies inside
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
class _Glance:
    """Holds a face detected in one rendered picture, projected onto the scan (in the scan's unit)."""

    detection: FaceDetection
    scan_from_face: Similarity  # of a mean adult's points, mm
    from_outside: bool  # a mask seen from behind shows a face, too, whose nose is farthest away


def unit_of(scale: float) -> tuple[str | None, float]:
    """Returns the unit's name, and its length in mm, in which a face has a human size; ``scale`` is the face's size in
    the scan's unit relative to a mean adult's in mm. If no unit fits, returns None and the factor to a mean adult's
    size."""
    for unit, factor in UNITS_MM.items():
        if SIZE_RANGE[0] < scale * factor < SIZE_RANGE[1]:
            return unit, factor
    return None, 1.0 / scale


def front_rig(world_from_face: Similarity) -> Rig:
    """Returns cameras in front of a face (mm), directed at its centre."""
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
    """Returns the best face detected in pictures from all sides: first along the axes, then, unless one detection is
    certain, from directions between the axes."""
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
    """Returns cameras directed at the origin along the axes, then along the diagonals."""
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
    pictures = {}
    for name, image in renderer.colour(rig, mesh, light=light).items():
        share = image[..., 3:].astype(float) / 255.0
        pictures[name] = np.rint(share * image[..., :3] + (1.0 - share) * np.array(BACKGROUND)).astype(np.uint8)
    return pictures


def _lifted(
    face: FaceDetection, camera: Camera, depth: Float[np.ndarray, "h w"], small_from_scan: Similarity
) -> _Glance | None:
    """Projects the detected points of a face onto the scan. Returns None if too few of these points lie on it."""
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
    """Returns whether the normals of the triangles in front of the face point into the head."""
    face_from_scan = scan_from_face.inverse()
    middles = face_from_scan.apply(mesh.vertices[mesh.faces].mean(axis=1))
    shape = point_table().shape_mm
    inside: Bool[np.ndarray, " f"] = ((middles > shape.min(axis=0)) & (middles < shape.max(axis=0) + 30.0)).all(axis=1)
    ahead = face_normals(mesh.vertices, mesh.faces[inside]) @ scan_from_face.rotation[:, 2]
    return bool(ahead.sum() < 0.0)


def nearest_axis(direction: Float[np.ndarray, " 3"]) -> str:
    """Returns the name of the axis nearest to a direction, such as "+y"."""
    largest = int(np.abs(direction).argmax())
    return ("+" if direction[largest] > 0 else "-") + "xyz"[largest]


def _lids(face: MatchedFaces, rig: Rig) -> Float[np.ndarray, "32 3"] | None:
    """Triangulates the edges of the lids from the eye network's image points, also for closed eyes."""
    seen = {name: found.lids_px for name, found in face.detections.items() if found.lids_px is not None}
    if len(seen) < 2:
        return None
    pixels = np.stack([*seen.values()])
    try:
        return triangulate_many(pixels, [rig[name] for name in seen], np.ones(pixels.shape[:2])).positions_world
    except NoPoint:
        return None


def deform_onto(
    carried: Float[np.ndarray, "t 3"], template: Template, model: HeadModel, scan: Surface
) -> tuple[Float[np.ndarray, "t 3"], Bool[np.ndarray, " t"]]:
    """Deforms a template onto a nearby scan. Returns all vertices, and a mask of the vertices that lie on the scan.

    The template's parts that contain skin are deformed as one surface, starting from the registered shape, so that lips
    and lids stay smooth; deeper vertices of these parts follow by stiffness. All other parts of the template follow the
    skin (``SurfaceBinding.with_skin``)."""
    binding, target = template.surface_binding, MetSurface(scan)
    welded, joined = weld(Surface.of(binding.rest, template.mesh.triangles()))
    first = np.unique(joined, return_index=True)[1]  # a row of the file for every joined vertex
    is_skin = np.zeros(len(welded.vertices), bool)
    is_skin[joined[binding.skin]] = True
    parts = components(welded)
    rows = np.flatnonzero(np.isin(parts, np.unique(parts[is_skin])))
    place = np.full(len(parts), -1)
    place[rows] = np.arange(len(rows))
    faces = place[welded.faces[(place[welded.faces] >= 0).all(axis=1)]].astype(np.int32)
    start, goal, skin = welded.vertices[rows], carried[first][rows], is_skin[rows]
    outside = skin | ~_near_face(start, model)

    known = np.where(skin, 1.0, np.where(outside, FOLLOWING, 0.0))
    start = draw_to_matches(start, faces, lambda shape: (goal, known), (CARRYING,))
    weight = np.zeros(len(rows))
    reaches = iter(REACH_MM)

    def match(shape: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        nonlocal weight
        stage = Stage(1, None, next(reaches), 0.0, 0.0)
        met, planes, _, weight = target.meet(shape, vertex_normals(shape, faces), stage)
        weight = np.where(outside, weight, 0.0)
        along = np.einsum("nx,nx->n", met - shape, planes)
        return shape + along[:, None] * planes, weight

    drawn = draw_to_matches(start, faces, match, STIFFNESS)
    drawn = untangle(drawn, topology_of(faces, len(drawn)))
    whole, met = np.zeros((len(parts), 3)), np.zeros(len(parts), bool)
    whole[rows], met[rows] = drawn, weight > 0.0
    out = binding.with_skin(whole[joined[binding.skin]])
    in_parts = place[joined] >= 0
    out[in_parts] = whole[joined[in_parts]]
    return out, met[joined]


def _near_face(points: Float[np.ndarray, "n 3"], model: HeadModel) -> Bool[np.ndarray, " n"]:
    """Returns a mask of the points of a registered template that lie near the face of the mean head. Points there that
    show no skin belong to the mouth, the nose or the eye sockets."""
    mean = model.vertices(np.zeros(0))
    return KDTree(mean[model.levels["full"].face_region]).query(points)[0] < FACE_MM


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """Holds a scan with its unit and axes, and the pose of the mean head on the scan."""

    scan: RawScan  # turned over where its triangles looked inwards
    turned_over: bool
    unit: str | None  # None where no unit makes it a head, and a mean adult's size was assumed
    mm_per_unit: float
    head_from_scan: Similarity  # into the frame and scale of the model's mean head
    marks: SurfaceMarks  # in that frame
    views: int  # renders that show the face; 0 where landmarks placed it

    @property
    def up(self) -> str:
        """Returns the scan's axis nearest to the head's upward direction, such as "+y"."""
        return nearest_axis(self.head_from_scan.rotation[1])

    @property
    def front(self) -> str:
        """Returns the scan's axis nearest to the direction in which the face points."""
        return nearest_axis(self.head_from_scan.rotation[2])

    def surface(self) -> Surface:
        """Returns the scan's surface in the mean head's frame and scale."""
        return Surface.of(self.head_from_scan.apply(self.scan.mesh.vertices), self.scan.mesh.faces)


def place_scan(
    scan: RawScan, model: HeadModel, landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None
) -> PlacedScan:
    """Places a scan by its detected face, or by landmarks in the scan's frame. Raises InputError if no face is
    detected, or if too few landmarks are given."""
    if not landmarks:
        with Renderer.create() as renderer:
            return _place_on_face(scan, model, load_networks(), renderer)
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


def _place_on_face(scan: RawScan, model: HeadModel, networks: FaceNetworks, renderer: Renderer) -> PlacedScan:
    """Places a scan by its detected face of any size; the face points, with the edges of the lids, become marks for the
    fit. Raises InputError if no rendered picture shows a face."""
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
    places, lids_mm = landmark_map(model), _lids(matched, rig)
    which, mean = np.flatnonzero(~places.slides), model.vertices(np.zeros(0))
    found = matched.points_world[which]
    weights = 1.0 / (places.deviation_mm[which] ** 2).sum(axis=1)
    head_from_mm = procrustes(found, places.expected(mean)[which], weights)
    points, deviation = places.points(mean), np.full(places.rows.shape, MARK_MM)
    points[which] = head_from_mm.apply(found) - places.offset_mm[which]
    if lids_mm is not None:
        points[LIDS], deviation[LIDS] = head_from_mm.apply(lids_mm[np.r_[EDGES, EDGES + 16]]), LID_MM
    return PlacedScan(
        scan=scan,
        turned_over=inward,
        unit=unit,
        mm_per_unit=factor,
        head_from_scan=head_from_mm @ Similarity(factor, np.eye(3), np.zeros(3)),
        marks=SurfaceMarks(places.rows[which], places.weights[which], points[which], deviation[which]),
        views=len(matched.detections),
    )


MIN_COVERED = 0.5  # of the model's face region: less is no face
LIKE_MM = 3.0  # median distance of the fitted face from the scan: more is another thing than a head
SCAN_POINTS = 20_000  # of the scan, whose distance from the template is measured


@dataclass(frozen=True, slots=True, eq=False)
class Wrapped:
    """Holds a template on a scan, in the scan's frame and unit."""

    template: Template
    placed: PlacedScan
    vertices: Float[np.ndarray, "t 3"]
    covered: Bool[np.ndarray, " t"]  # vertices that lie on the scan; others continue the shape where it has nothing
    distance_mm: Float[np.ndarray, " t"]  # of every vertex from the scan's surface
    scan_distance_mm: Float[np.ndarray, " n"]  # of points of the scan from the template, where the template is
    likeness: Likeness
    index: SurfaceIndex  # of the scan, own frame

    def hits(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Hits:
        """Returns the closest points of the scan whose normals have a similar direction."""
        return _closest(self.index, points, normals, self.placed.mm_per_unit)

    def figures(self) -> dict[str, float]:
        """Returns quality figures of the wrapping by name, for printing."""
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
    """Wraps a scan in the vertex order of a template.

    Args:
        scan: the scan, in any unit and orientation.
        template: a template registered to ``model``.
        model: the head model.
        landmarks: landmarks in the scan's frame; None detects the face in rendered pictures.
        report: progress.

    Raises InputError if the scan shows no face, or is not a head."""
    report("finding the face", 0.0)
    placed = place_scan(scan, model, landmarks)
    surface = placed.surface()
    report("fitting the model", 0.3)
    like = fit_model_to_mesh(with_expressions(model), surface, placed.marks, STAGES)
    carried = template.surface_binding.on(like.vertices, model.levels["full"].faces)
    report("drawing the template", 0.6)
    drawn, met = deform_onto(carried, template, model, surface)
    _check(like, scan.name)
    report("measuring", 0.9)
    vertices = placed.head_from_scan.inverse().apply(drawn)
    mesh, triangles = placed.scan.mesh, template.mesh.triangles()
    index = SurfaceIndex(mesh.vertices, mesh.faces, 2.0 / placed.mm_per_unit)
    hits = _closest(index, vertices, vertex_normals(vertices, triangles), placed.mm_per_unit)
    return Wrapped(
        template=template,
        placed=placed,
        vertices=vertices,
        covered=met,
        distance_mm=hits.distances * placed.mm_per_unit,
        scan_distance_mm=_scan_distances(placed, vertices, triangles, met),
        likeness=like,
        index=index,
    )


def residual_colours(distance_mm: Float[np.ndarray, " t"], covered: Bool[np.ndarray, " t"]) -> UInt8[np.ndarray, "t 3"]:
    """Returns colours for distances: white at 0, yellow at 0.5 mm, red from 1 mm on; grey for missing scan surface."""
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
    """Returns the distances (mm) of the scan's points from the template, for points whose closest triangle of the
    template lies on the scan."""
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
