"""A model's expressions on a registered mesh: how far each of its vertices moves with each shape.

The skin moves as its attachment says (``carrying``). What lies deeper is attached, too, where the mesh leads to it over
vertices that move alike: an expression parts lips that touch, so that the smooth map in space that carries a person's
shape would tear the inside of one lip along with the other. Vertices that cannot be attached move with their neighbours
on the mesh. Parts of their own, not joined to the skin, are

- round and closed: eyeballs, which no shape moves (turn them about their pivots);
- at the skin: lashes and brows, which stand on the triangle of the skin at their roots and turn with it;
- inside: teeth and tongue, which stay with the skull, or, below the line of the lips, move with the jaw.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu

from pipeline.applications.templates.carrying import Attachment, SurfaceBinding, bind_vertices, frames
from pipeline.applications.templates.pivots import Points, in_mouth, jaw_motions
from pipeline.geometry.surface_index import SurfaceIndex
from rig.mesh import vertex_normals

Places = Float[np.ndarray, "t 3"]

OFF_MM, FACING = 1.5, 0.4  # as the registration has it: what is farther off, or faces away, lies deeper
ALIKE = 2.0  # millimetres that neighbours may part by, a millimetre between them: 99 % of the models' own do by less
ALIKE_MM = 0.5
ROOT_MM = 3.0  # a part that comes so near to the skin is rooted there
Shapes = Mapping[str, Float[np.ndarray, "v 3"]]


@dataclass(frozen=True, slots=True, eq=False)
class Neutral:
    """Holds a head without expression: the model's full level (mm) and its triangles, and where the mesh lies on it."""

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
    """Returns the displacement of each vertex of a mesh (mm, weight 1), by shape; everything in the head frame.

    ``surface_binding``: how the model carries the mesh. ``triangles``: of the mesh. ``neutral``: the head that the
    shapes start from. ``shapes``: displacements of the model's full level. ``landmarks``: of that head.
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
    """Returns the number of the part of its own that each vertex of a mesh belongs to, -1 of what is joined to the
    skin."""
    edges = _edges(triangles)
    parts = connected_components(_matrix(edges, np.ones(len(edges)), count), directed=False)[1]
    return np.where(np.isin(parts, np.unique(parts[surface_binding.skin])), -1, parts)


def _edges(triangles: Int[np.ndarray, "g 3"]) -> Int[np.ndarray, "e 2"]:
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    pairs = np.unique(pairs, axis=0)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _matrix(edges: Int[np.ndarray, "e 2"], values: np.ndarray, count: int) -> sparse.csr_array:
    """Returns the symmetric matrix with a value for each edge."""
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return sparse.csr_array((np.concatenate([values, values]), (rows, columns)), shape=(count, count))


def _with_skin(attachment: Attachment, surface_binding: SurfaceBinding) -> Attachment:
    """Returns the attachment of all vertices in which those of the skin are attached as they were registered."""
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
    """Tells which vertices the surface carries: the skin, and what edges lead to from it over vertices that are near
    the surface and move alike in every shape."""
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
    """Sets the moves of vertices to the mean of their neighbours', nearer ones weighing more, while leading vertices
    keep theirs."""
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
    """Returns how each vertex would move if it were fixed to the lower jaw."""
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
    """Returns the moves of a part that stands on the skin; None if it comes near no skin."""
    hits = SurfaceIndex(mesh, skin).closest(mesh[rows])
    roots = hits.distances < ROOT_MM
    if not roots.any():
        return None
    return _standing(mesh, rows, skin[hits.triangles[_nearest_root(mesh, edges, rows, roots)]], moves)


def _nearest_root(
    mesh: Places, edges: Int[np.ndarray, "e 2"], rows: Int[np.ndarray, " r"], roots: Bool[np.ndarray, " r"]
) -> Int[np.ndarray, " r"]:
    """Returns for each vertex of a part which of its roots is the nearest along its edges."""
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
    """Returns the moves of vertices that stand on triangles of the mesh's own skin and turn with them."""
    used, local = np.unique(corners, return_inverse=True)
    faces, rest = local.reshape(-1, 3), mesh[used]
    thirds = np.full((len(rows), 3), 1.0 / 3.0)
    standing = Attachment(np.arange(len(rows)), thirds, np.zeros((len(rows), 3)))
    from_skin = mesh[rows] - standing.on(rest, faces)
    axes = frames(rest[faces])
    standing = Attachment(standing.triangles, thirds, np.einsum("nax,nx->na", axes, from_skin))
    at_rest = standing.on(rest, faces)
    return np.stack([standing.on(rest + moves[used, k], faces) - at_rest for k in range(moves.shape[1])], axis=1)
