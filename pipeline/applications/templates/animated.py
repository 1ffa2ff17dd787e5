"""Builds a head for animation, either in a template's vertex order or in the head model's. The head gets Apple's 52
blendshapes, rotation centres (pivots) and, if its mesh lacks them, eyeballs, teeth and tongue. A template also gets
visemes and blendshapes without crossing triangles.

The lips of a fitted head may be some tenths of a millimetre apart, and teeth would show through the gap. A gap of this
width is closed; a wider gap counts as an open mouth and does not change. The inner edge of open lips is smoothed.

A head model's expressions move a template as follows: each skin vertex moves with the head model's triangle to which it
is attached (``carrying``). Vertices below the skin are attached too if mesh edges connect them to the skin over
vertices with similar displacements. A smooth map of space would not suffice: where an expression parts two touching
lips, it would tear the inside of one lip along with the other lip. Vertices that cannot be attached get the mean
displacement of their neighbours in the mesh. Parts of the mesh that no edge connects to the skin belong to three kinds:

- Eyeballs are round and closed, and no blendshape moves them: an animator rotates them about their pivots.
- Lashes and brows stand on the skin, and rotate with the skin triangle at their roots.
- Teeth and tongue lie inside the head. Below the line between the lips both move with the jaw, above it with the skull.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu

from pipeline.applications.templates.carrying import Attachment, SurfaceBinding, bind_vertices, frames
from pipeline.applications.templates.contact import RestSurface, keep_apart, prepare_rest_surface
from pipeline.applications.templates.eyeballs import STRAIGHT, Eyeball, lift_lids, place_eyeballs
from pipeline.applications.templates.inner_mouth import InnerMouth, keep_off_teeth, place_inner_mouth
from pipeline.applications.templates.pivots import EYE_REACH_MM, Points, in_mouth, jaw_motions, pivots
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.expressions import VISEMES, mixed
from pipeline.head_model.subdivision import boundary_loops
from rig.geometry import RigidTransform
from rig.mesh import vertex_normals

LIDS = "eye"  # how names of shapes that close or move lids begin
PARTED_MM = 1.5  # lips further apart are open
PRESS_MM = 0.1  # by which shut lips overlap, so that no slit is left between the corners of their triangles
LIP_MM = 14.0  # from the inner edge over a lip to its skin
FADE_MM = 4.0  # over which a lip's shift fades to the skin about it
COLUMN_MM = 0.5  # width of the strips in which the gap is measured
SPREAD_COLUMNS = 5  # over which the widest gap counts: a triangle of a lip is as wide
SMOOTH_ROUNDS = 12  # of the inner edge; they take out scallops of four edges' length
Places = Float[np.ndarray, "t 3"]

OFF_MM, FACING = 1.5, 0.4  # as in the registration: vertices farther off, or facing away, lie deeper
ALIKE = 2.0  # millimetres that neighbours may part by, a millimetre between them: 99 % of the models' own do by less
ALIKE_MM = 0.5
ROOT_MM = 3.0  # a part this near to the skin is rooted there
Shapes = Mapping[str, Float[np.ndarray, "v 3"]]


@dataclass(frozen=True, slots=True, eq=False)
class Neutral:
    """Holds a head without expression: vertices (mm) and triangles of the model's finest mesh, and a template on it."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    mesh: Places


def carried_shapes(
    surface_binding: SurfaceBinding,
    triangles: Int[np.ndarray, "g 3"],
    neutral: Neutral,
    shapes: Shapes,
    landmarks: Points,
) -> dict[str, Places]:
    """Returns the displacement of each vertex of a template (mm, at weight 1), by name of the blendshape, in the head
    frame.

    ``surface_binding``: binding of the mesh to the model. ``triangles``: triangles of the mesh. ``neutral``: head
    without expression. ``shapes``: displacements of its finest mesh. ``landmarks``: landmarks of this head.
    """
    names = list(shapes)
    mesh, count = neutral.mesh, len(neutral.mesh)
    edges = _edges(triangles)
    parts = loose_parts(surface_binding, triangles, count)
    joined = parts < 0
    attachment, off, facing = bind_vertices(mesh, vertex_normals(mesh, triangles), neutral.vertices, neutral.faces)
    attachment = _with_skin(attachment, surface_binding)
    moves = np.stack([_moved(attachment, neutral, shapes[name]) for name in names], axis=1)  # (t, shapes, 3)
    near = joined & (off < OFF_MM) & (facing > FACING)
    attached = _led(mesh, edges, moves, surface_binding.skin, near)
    _follow(mesh, edges, moves, attached, joined & ~attached)
    skin = triangles[joined[triangles].all(axis=1)]
    jaw = _jaw_moves(landmarks, neutral, shapes, mesh)
    for part in np.unique(parts[~joined]):
        rows = np.flatnonzero(parts == part)
        ball = (surface_binding.wholes[rows] >= 0).all()
        standing = None if ball else _standing_at_roots(mesh, edges, rows, skin, moves)
        with_jaw = jaw[rows] if in_mouth(landmarks, mesh[rows]) and not ball else 0.0
        moves[rows] = with_jaw if standing is None else standing
    return {name: moves[:, k] for k, name in enumerate(names)}


def loose_parts(
    surface_binding: SurfaceBinding, triangles: Int[np.ndarray, "g 3"], count: int
) -> Int[np.ndarray, " t"]:
    """Returns the index of the separate part to which each vertex of a mesh belongs, -1 for vertices connected to the
    skin."""
    edges = _edges(triangles)
    parts = connected_components(_matrix(edges, np.ones(len(edges)), count), directed=False)[1]
    return np.where(np.isin(parts, np.unique(parts[surface_binding.skin])), -1, parts)


def _edges(triangles: Int[np.ndarray, "g 3"]) -> Int[np.ndarray, "e 2"]:
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    pairs = np.unique(pairs, axis=0)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _matrix(edges: Int[np.ndarray, "e 2"], values: np.ndarray, count: int) -> sparse.csr_array:
    """Returns a symmetric sparse matrix with one value for each edge."""
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return sparse.csr_array((np.concatenate([values, values]), (rows, columns)), shape=(count, count))


def _with_skin(attachment: Attachment, surface_binding: SurfaceBinding) -> Attachment:
    """Returns the attachment in which skin vertices have the attachment of the registered template."""
    skin, registered = surface_binding.skin, surface_binding.attachment
    for whole, part in (
        (attachment.triangles, registered.triangles),
        (attachment.weights, registered.weights),
        (attachment.offsets, registered.offsets),
    ):
        whole[skin] = part
    return attachment


def _moved(attachment: Attachment, neutral: Neutral, shape: Float[np.ndarray, "v 3"]) -> Places:
    at_rest = attachment.on(neutral.vertices, neutral.faces)
    return attachment.on(neutral.vertices + shape, neutral.faces) - at_rest


def _led(
    mesh: Places,
    edges: Int[np.ndarray, "e 2"],
    moves: Float[np.ndarray, "t s 3"],
    skin: Int[np.ndarray, " n"],
    near: Bool[np.ndarray, " t"],
) -> Bool[np.ndarray, " t"]:
    """Returns a mask of the vertices that move with the head model's surface: the skin, and near vertices connected to
    it by edges over vertices with similar displacements."""
    a, b = edges.T
    parting = np.linalg.norm(moves[a] - moves[b], axis=2).max(axis=1, initial=0.0)
    alike = parting < ALIKE * np.linalg.norm(mesh[a] - mesh[b], axis=1) + ALIKE_MM
    usable = near.copy()
    usable[skin] = True
    edges = edges[alike & usable[a] & usable[b]]
    group = connected_components(_matrix(edges, np.ones(len(edges)), len(mesh)), directed=False)[1]
    return np.isin(group, np.unique(group[skin])) & usable


def _follow(
    mesh: Places,
    edges: Int[np.ndarray, "e 2"],
    moves: Float[np.ndarray, "t s 3"],
    leading: Bool[np.ndarray, " t"],
    following: Bool[np.ndarray, " t"],
) -> None:
    """Sets the displacements of the ``following`` vertices to the mean of their neighbours' displacements, weighted by
    nearness."""
    rows, fixed = np.flatnonzero(following), np.flatnonzero(leading)
    if not len(rows):
        return
    length = np.linalg.norm(mesh[edges[:, 0]] - mesh[edges[:, 1]], axis=1)
    weight = _matrix(edges, 1.0 / np.maximum(length, 0.1), len(mesh))
    total = np.asarray(weight.sum(axis=1)).ravel()[rows]
    system = sparse.csc_array(sparse.diags_array(total + 1e-9) - weight[rows][:, rows])
    right = weight[rows][:, fixed] @ moves[fixed].reshape(len(fixed), -1)
    moves[rows] = splu(system).solve(right).reshape(len(rows), *moves.shape[1:])


def _jaw_moves(landmarks: Points, neutral: Neutral, shapes: Shapes, mesh: Places) -> Float[np.ndarray, "t s 3"]:
    """Returns the displacement that each vertex would have if it were fixed to the lower jaw."""
    motions = jaw_motions(landmarks, neutral.vertices, shapes)
    still = np.zeros_like(mesh)
    return np.stack([motions[name].apply(mesh) - mesh if name in motions else still for name in shapes], axis=1)


def _standing_at_roots(
    mesh: Places,
    edges: Int[np.ndarray, "e 2"],
    rows: Int[np.ndarray, " r"],
    skin: Int[np.ndarray, "g 3"],
    moves: Float[np.ndarray, "t s 3"],
) -> Float[np.ndarray, "r s 3"] | None:
    """Returns the displacements of a part that stands on the skin, such as lashes; None if it is not near the skin."""
    hits = SurfaceIndex(mesh, skin).closest(mesh[rows])
    roots = hits.distances < ROOT_MM
    if not roots.any():
        return None
    return _standing(mesh, rows, skin[hits.triangles[_nearest_root(mesh, edges, rows, roots)]], moves)


def _nearest_root(
    mesh: Places, edges: Int[np.ndarray, "e 2"], rows: Int[np.ndarray, " r"], roots: Bool[np.ndarray, " r"]
) -> Int[np.ndarray, " r"]:
    """Returns, for each vertex of a part, the root vertex that is nearest along the part's edges."""
    number = np.full(len(mesh), -1)
    number[rows] = np.arange(len(rows))
    inside = edges[(number[edges] >= 0).all(axis=1)]
    length = np.maximum(np.linalg.norm(mesh[inside[:, 0]] - mesh[inside[:, 1]], axis=1), 1e-6)
    graph = _matrix(number[inside], length, len(rows))
    _, _, source = dijkstra(graph, indices=np.flatnonzero(roots), min_only=True, return_predecessors=True)
    return np.asarray(source, int)


def _standing(
    mesh: Places, rows: Int[np.ndarray, " r"], corners: Int[np.ndarray, "r 3"], moves: Float[np.ndarray, "t s 3"]
) -> Float[np.ndarray, "r s 3"]:
    """Returns the displacements of vertices that stand on the template's skin triangles and rotate with them."""
    used, local = np.unique(corners, return_inverse=True)
    faces, rest = local.reshape(-1, 3), mesh[used]
    thirds = np.full((len(rows), 3), 1.0 / 3.0)
    standing = Attachment(np.arange(len(rows)), thirds, np.zeros((len(rows), 3)))
    from_skin = mesh[rows] - standing.on(rest, faces)
    axes = frames(rest[faces])
    standing = Attachment(standing.triangles, thirds, np.einsum("nax,nx->na", axes, from_skin))
    at_rest = standing.on(rest, faces)
    return np.stack([standing.on(rest + moves[used, k], faces) - at_rest for k in range(moves.shape[1])], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class AnimatedMesh:
    """Holds a mesh without expression, its blendshapes and its pivots, in the head frame, mm."""

    neutral: Float[np.ndarray, "t 3"]
    shapes: Mapping[str, Float[np.ndarray, "t 3"]]  # displacements at weight 1: Apple's, others of the head, visemes
    pivots: Mapping[str, Float[np.ndarray, " 3"]]
    eyeballs: Mapping[str, Int[np.ndarray, " b"]]  # rows of the mesh, by pivot
    added: Mapping[str, Eyeball] = field(default_factory=dict)  # eyeballs that the mesh lacks, by pivot
    inner: InnerMouth = field(default_factory=InnerMouth)  # teeth and tongue that the mesh lacks
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)  # gazes of measured eyes, by pivot


def animate_mesh(
    surface_binding: SurfaceBinding,
    triangles: Int[np.ndarray, "g 3"],
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    shapes: Mapping[str, Float[np.ndarray, "v 3"]],
    landmark_rows: Mapping[str, int],
    *,
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = STRAIGHT,
) -> AnimatedMesh:
    """Transfers a head model's blendshapes to a template, keeps lips and lids from crossing, and adds visemes, pivots,
    eyeballs, teeth and a tongue.

    ``surface_binding``: binding of the mesh to the model. ``triangles``: triangles of the mesh. ``vertices``: the
    model's finest mesh without expression, head frame, mm. ``faces``: its triangles. ``shapes``: its displacements, by
    Apple's names or the model's. ``landmark_rows``: the indices of its landmarks. ``gazes``: directions of the eyes
    (unit vectors, head frame), by pivot; missing ones are straight ahead.
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
    parted = parted_shapes(prepare_rest_surface(mesh, triangles), carried)
    loose = np.where(surface_binding.wholes >= 0, -1, loose_parts(surface_binding, triangles, len(mesh)))
    jaw = jaw_motions(landmarks, vertices, shapes)
    bare = AnimatedMesh(mesh, parted, found, eyes, gazes=gazes)
    return _with_parts(bare, triangles, landmarks, jaw, loose)


def animate_head(
    vertices: Float[np.ndarray, "v 3"],
    opened: Int[np.ndarray, "f 3"],
    shapes: Mapping[str, Float[np.ndarray, "v 3"]],
    landmark_rows: Mapping[str, int],
    *,
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = STRAIGHT,
) -> AnimatedMesh:
    """Closes the lips of the head model's finest mesh, and adds pivots, eyeballs, teeth and tongue (head frame, mm).
    The triangles ``opened`` leave holes at the eyes and the mouth. The model's blendshapes move lips and lids."""
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
    """Returns the mesh with missing eyeballs, teeth and tongue, and with lids and lips corrected to avoid them."""
    mesh, shapes = bare.neutral, bare.shapes
    lacking = {name: at for name, at in bare.pivots.items() if name.startswith("eye_") and name not in bare.eyeballs}
    added = place_eyeballs(mesh, triangles, landmarks, lacking, bare.gazes)
    if added:
        shapes = {name: lift_lids(mesh, triangles, shape, added) for name, shape in shapes.items()}
    inner = place_inner_mouth(mesh, triangles, shapes, landmarks, jaw, loose)
    shapes = keep_off_teeth(mesh, triangles, shapes, inner)
    centres = {name: eyeball.centre for name, eyeball in added.items()}
    return replace(bare, shapes=shapes, pivots={**bare.pivots, **centres}, added=added, inner=inner)


def parted_shapes(
    rest: RestSurface, shapes: Mapping[str, Float[np.ndarray, "t 3"]]
) -> dict[str, Float[np.ndarray, "t 3"]]:
    """Returns the blendshapes corrected until no triangles cross, and visemes mixed from the corrected blendshapes.

    ``mouthClose`` closes a mouth that ``jawOpen`` has opened, and is corrected together with ``jawOpen``: by
    Apple's definition, lips cross if ``mouthClose`` is used alone."""
    out = {
        name: keep_apart(rest, shape, closing=name.startswith(LIDS))
        for name, shape in shapes.items()
        if name != "mouthClose"
    }
    if "mouthClose" in shapes:
        jaw = out.get("jawOpen", np.zeros_like(rest.vertices))
        out["mouthClose"] = keep_apart(rest, jaw + shapes["mouthClose"], closing=False) - jaw
    out = {name: out[name] for name in shapes}
    return out | {name: keep_apart(rest, mixed(out, mixture), closing=False) for name, mixture in VISEMES.items()}


def shut_lips(
    vertices: Float[np.ndarray, "v 3"], opened: Int[np.ndarray, "f 3"], landmarks: Points
) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices of a head (head frame, mm) after a nearly shut mouth has been closed. The triangles
    ``opened`` leave a hole at the mouth."""
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
    """Returns the vertex indices of the upper and of the lower lip: each vertex belongs to the half of the lips' inner
    edge that is nearer along the mesh."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    long = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    graph = sparse.csr_array((long, (ends[:, 0], ends[:, 1])), shape=(len(vertices), len(vertices)))
    start, end = sorted((int(vertices[rim, 0].argmin()), int(vertices[rim, 0].argmax())))
    halves = rim[start + 1 : end], np.concatenate([rim[end + 1 :], rim[:start]])
    away = [dijkstra(graph, directed=False, indices=half, min_only=True, limit=LIP_MM) for half in halves]
    found = [np.flatnonzero((away[k] < LIP_MM) & (away[k] < away[1 - k])) for k in (0, 1)]
    found.sort(key=lambda rows: -vertices[rows, 1].mean())
    return found[0], found[1]
