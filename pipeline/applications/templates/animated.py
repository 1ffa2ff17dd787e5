"""A head that can be animated, in a registered mesh or in the model's own: Apple's 52 shapes, its pivots, and
eyeballs, teeth and a tongue where its eyes are open and its lips part and it has none. A registered mesh has the
visemes, too, and shapes without crossing.

The lips of a fitted head may lie some tenths of a millimetre apart, through which teeth would shine: what photographs
show of shut lips is a dark line, and the surface there is the model's. They are shut; a wider gap is an open mouth, and
stays. The inner edge at which an open mouth ends is smoothed."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.sparse.csgraph import dijkstra

from pipeline.applications.templates.carrying import SurfaceBinding
from pipeline.applications.templates.contact import RestSurface, kept_apart, rest_surface
from pipeline.applications.templates.eyeballs import STRAIGHT, Eyeball, lifted, placed_eyeballs
from pipeline.applications.templates.inner_mouth import InnerMouth, kept_off_teeth, placed_inner_mouth
from pipeline.applications.templates.pivots import EYE_REACH_MM, Points, jaw_motions, pivots
from pipeline.applications.templates.shape_carrying import Neutral, carried_shapes, loose_parts
from pipeline.head_model.subdivision import boundary_loops
from pipeline.head_model.visemes import VISEMES, mixed
from rig.geometry import RigidTransform

LIDS = "eye"  # what the names of shapes that close or move lids begin with
PARTED_MM = 1.5  # lips further apart are open
PRESS_MM = 0.1  # by which shut lips overlap, so that no slit is left between the corners of their triangles
LIP_MM = 14.0  # from the inner edge over a lip to its skin
FADE_MM = 4.0  # over which a lip's shift fades to the skin about it
COLUMN_MM = 0.5  # width of the strips in which the gap is measured
SPREAD_COLUMNS = 5  # over which the widest gap counts: a triangle of a lip is as wide
SMOOTH_ROUNDS = 12  # of the inner edge; they take out scallops of four edges' length


@dataclass(frozen=True, slots=True, eq=False)
class AnimatedMesh:
    """Holds a mesh without expression, its shapes and its pivots, in the head frame, mm."""

    neutral: Float[np.ndarray, "t 3"]
    shapes: Mapping[str, Float[np.ndarray, "t 3"]]  # displacements at weight 1: Apple's, others of the head, visemes
    pivots: Mapping[str, Float[np.ndarray, " 3"]]
    eyeballs: Mapping[str, Int[np.ndarray, " b"]]  # rows of the mesh, by pivot
    added: Mapping[str, Eyeball] = field(default_factory=dict)  # eyeballs that the mesh lacks, by pivot
    inner: InnerMouth = field(default_factory=InnerMouth)  # teeth and tongue that the mesh lacks
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)  # of eyes that were seen, by pivot


def animated_mesh(
    surface_binding: SurfaceBinding,
    triangles: Int[np.ndarray, "g 3"],
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    shapes: Mapping[str, Float[np.ndarray, "v 3"]],
    landmark_rows: Mapping[str, int],
    *,
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = STRAIGHT,
) -> AnimatedMesh:
    """Carries shapes to a mesh and keeps its lips and lids apart; adds the visemes, pivots, eyeballs, teeth and tongue.

    ``surface_binding``: how the model carries the mesh. ``triangles``: of the mesh. ``vertices``: the model's full
    level without expression, head frame, mm. ``faces``: its triangles. ``shapes``: displacements of that level, by
    Apple's names or the model's. ``landmark_rows``: the model's landmarks, rows of that level. ``gazes``: where eyes
    look (unit vectors, head frame), by pivot; straight ahead where there is none.
    """
    mesh = surface_binding.on(vertices, faces)
    landmarks: Points = {name: vertices[row] for name, row in landmark_rows.items()}
    carried = carried_shapes(surface_binding, triangles, Neutral(vertices, faces, mesh), shapes, landmarks)
    balls = [
        np.flatnonzero(surface_binding.wholes == number) for number in range(surface_binding.wholes.max(initial=-1) + 1)
    ]
    found = pivots(landmarks, vertices, shapes, [mesh[rows] for rows in balls])
    eyes = {
        name: rows
        for name, pivot in found.items()
        for rows in balls
        if name.startswith("eye_") and np.linalg.norm(mesh[rows].mean(axis=0) - pivot) < 0.5 * EYE_REACH_MM
    }
    parted = parted_shapes(rest_surface(mesh, triangles), carried)
    loose = np.where(surface_binding.wholes >= 0, -1, loose_parts(surface_binding, triangles, len(mesh)))
    jaw = jaw_motions(landmarks, vertices, shapes)
    bare = AnimatedMesh(mesh, parted, found, eyes, gazes=gazes)
    return _with_parts(bare, triangles, landmarks, jaw, loose)


def animated_head(
    vertices: Float[np.ndarray, "v 3"],
    opened: Int[np.ndarray, "f 3"],
    shapes: Mapping[str, Float[np.ndarray, "v 3"]],
    landmark_rows: Mapping[str, int],
    *,
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = STRAIGHT,
) -> AnimatedMesh:
    """Shuts the lips of a model's full level (head frame, mm), and adds pivots, eyeballs, teeth and a tongue. The
    triangles ``opened`` leave out what closes eyes and mouth. Lips and lids move as the model's shapes have them."""
    landmarks: Points = {name: vertices[row] for name, row in landmark_rows.items()}
    vertices = shut_lips(vertices, opened, landmarks)
    bare = AnimatedMesh(vertices, shapes, pivots(landmarks, vertices, shapes, []), {}, gazes=gazes)
    jaw = jaw_motions(landmarks, vertices, shapes)
    return _with_parts(bare, opened, landmarks, jaw, np.full(len(vertices), -1))


def _with_parts(
    bare: AnimatedMesh,
    triangles: Int[np.ndarray, "g 3"],
    landmarks: Points,
    jaw: Mapping[str, RigidTransform],
    loose: Int[np.ndarray, " t"],
) -> AnimatedMesh:
    """Returns the mesh with the eyeballs, teeth and tongue that it lacks, and lids and lips that keep off them."""
    mesh, shapes = bare.neutral, bare.shapes
    lacking = {name: at for name, at in bare.pivots.items() if name.startswith("eye_") and name not in bare.eyeballs}
    added = placed_eyeballs(mesh, triangles, landmarks, lacking, bare.gazes)
    if added:
        shapes = {name: lifted(mesh, triangles, shape, added) for name, shape in shapes.items()}
    inner = placed_inner_mouth(mesh, triangles, shapes, landmarks, jaw, loose)
    shapes = kept_off_teeth(mesh, triangles, shapes, inner)
    centres = {name: eyeball.centre for name, eyeball in added.items()}
    return replace(bare, shapes=shapes, pivots={**bare.pivots, **centres}, added=added, inner=inner)


def parted_shapes(
    rest: RestSurface, shapes: Mapping[str, Float[np.ndarray, "t 3"]]
) -> dict[str, Float[np.ndarray, "t 3"]]:
    """Returns shapes without crossing, and the visemes mixed of them without crossing.

    ``mouthClose`` closes a mouth that ``jawOpen`` has opened, and is kept apart together with that shape: without it
    lips cross, as Apple's definition has it."""
    out = {
        name: kept_apart(rest, shape, closing=name.startswith(LIDS))
        for name, shape in shapes.items()
        if name != "mouthClose"
    }
    if "mouthClose" in shapes:
        jaw = out.get("jawOpen", np.zeros_like(rest.vertices))
        out["mouthClose"] = kept_apart(rest, jaw + shapes["mouthClose"], closing=False) - jaw
    out = {name: out[name] for name in shapes}
    return out | {name: kept_apart(rest, mixed(out, mixture), closing=False) for name, mixture in VISEMES.items()}


def shut_lips(
    vertices: Float[np.ndarray, "v 3"], opened: Int[np.ndarray, "f 3"], landmarks: Points
) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices (head frame, mm) with the lips shut where they are nearly so. ``opened``: the triangles
    without those that close the mouth."""
    rim = min(
        boundary_loops(opened), key=lambda loop: np.linalg.norm(vertices[loop].mean(axis=0) - landmarks["stomion"])
    )
    out = vertices.copy()
    for _ in range(SMOOTH_ROUNDS):
        before, after = np.roll(out[rim], 1, axis=0), np.roll(out[rim], -1, axis=0)
        out[rim] = 0.5 * out[rim] + 0.25 * (before + after)
    upper, lower = _lips(out, opened, np.array(rim))
    x = out[:, 0]
    columns = np.arange(x[rim].min(), x[rim].max(), COLUMN_MM)
    edges = []
    for lip, side in ((upper, 1.0), (lower, -1.0)):
        edge = np.full(len(columns), np.inf)
        np.minimum.at(edge, np.clip(np.searchsorted(columns, x[lip]) - 1, 0, len(columns) - 1), side * out[lip, 1])
        known = np.isfinite(edge)
        edges.append(side * np.interp(columns, columns[known], edge[known]))
    gap = edges[0] - edges[1]
    shut = np.where((gap > -PRESS_MM) & (gap < PARTED_MM), gap + PRESS_MM, 0.0)
    shut = gaussian_filter1d(maximum_filter1d(shut, SPREAD_COLUMNS, mode="nearest"), 1.0, mode="nearest")
    for lip, edge, way in ((upper, edges[0], -0.5), (lower, edges[1], 0.5)):
        far = np.abs(out[lip, 1] - np.interp(x[lip], columns, edge))
        inside = (x[lip] > columns[0]) & (x[lip] < columns[-1])
        shift = np.interp(x[lip], columns, shut) * np.exp(-0.5 * (far / FADE_MM) ** 2)
        out[lip, 1] += way * np.where(inside, shift, 0.0)
    return out


def _lips(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rim: Int[np.ndarray, " r"]
) -> tuple[Int[np.ndarray, " u"], Int[np.ndarray, " l"]]:
    """Returns the rows of the upper and of the lower lip: each vertex belongs to the half of the inner edge that is
    nearer along the mesh."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    long = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    graph = sparse.csr_array((long, (ends[:, 0], ends[:, 1])), shape=(len(vertices), len(vertices)))
    start, end = sorted((int(vertices[rim, 0].argmin()), int(vertices[rim, 0].argmax())))
    halves = rim[start + 1 : end], np.concatenate([rim[end + 1 :], rim[:start]])
    away = [dijkstra(graph, directed=False, indices=half, min_only=True, limit=LIP_MM) for half in halves]
    found = [np.flatnonzero((away[k] < LIP_MM) & (away[k] < away[1 - k])) for k in (0, 1)]
    found.sort(key=lambda rows: -vertices[rows, 1].mean())
    return found[0], found[1]
