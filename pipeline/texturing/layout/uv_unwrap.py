"""Computes the UV layout of a head or of a bust for a texture.

The head's mesh is cut from the nape over the back of the head to the crown. The mesh's border is then mapped to a
square with slightly bulging sides, the neck at the bottom. Every inner vertex is placed at the weighted mean of its
neighbours with mean-value weights (Floater, *Mean value coordinates*, CAGD 2003), so no two triangles overlap (Tutte's
theorem). Parts that become too small in the layout (nose, ears) are enlarged by changing the weights repeatedly
(Yoshizawa, Belyaev and Seidel, *A fast and simple stretch-minimizing mesh parameterization*, SMI 2004).

The layout is computed from a head model's mean head, so that a texel shows the same place of every subject's head.

The bust's mesh, in contrast, is divided into several UV charts. Each triangle is projected along one of six directions
(the head's axes), the one that the surface around it faces. If one part of the surface hides another, as an ear hides
the head, the hidden part gets a chart of its own. Charts are packed in rows of equal height.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg
from jaxtyping import Bool, Float, Float32, Int, UInt8

from pipeline.compute.array_cache import cached_arrays
from pipeline.compute.trace import traced
from pipeline.fusion.grid_kernels import component_of
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.head_model.model import HeadModel
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from rig.errors import EigenheadError
from rig.mesh import Mesh, face_normals
from rig.messages.message import compose

PIXEL_MM = 0.5  # of the picture that tells which sheet hides another
FAR_MM = 10_000.0  # of the camera that draws it
MAX_SHEETS = 8  # behind each other; in a tangle of curls the last ones share their texels
CHART_MARGIN = 1 / 512  # of the texture's side, between charts
WIDER = 1.02  # by what the square grows until all charts fit
Faces = Int[np.ndarray, "f 3"]

ROUNDS = 4  # of reweighting
BULGE = 0.02  # of the square's side
MARGIN = 0.01  # left free around the square
SIDE_SHARE = 2 / 3  # of the cut that is one of the square's sides; the rest is half of its top


class NoLayout(EigenheadError):
    """Reports a mesh that cannot be unwrapped, since it is not one piece with one open border."""

    def __init__(self) -> None:
        super().__init__(compose("model-without-layout"))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Holds the UV layout of a mesh that was cut open. ``source`` is the mesh vertex of each layout vertex; ``uv`` is
    its position in the unit square, v downwards as in glTF."""

    uv: Float[np.ndarray, "n 2"]
    faces: Faces
    source: Int[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """Holds a UV layout and its texture image (sRGB)."""

    layout: Layout
    image: UInt8[np.ndarray, "s s 3"]


def unwrap(vertices: Float[np.ndarray, "v 3"], faces: Faces) -> Layout:
    """Cuts the mesh of a head open from the nape to the crown, and maps it to the unit square. Raises NoLayout unless
    the mesh is one piece with one open border, at the neck."""
    border = _border(faces)
    back = int(border[np.argmin(vertices[border, 2] + np.abs(vertices[border, 0]))])
    crown = int(np.argmax(vertices[:, 1]))
    cut, source = _cut_open(faces, len(vertices), _path(vertices, faces, back, crown))
    points, loop = vertices[source], _border(cut)
    starts = np.flatnonzero(source[loop] == back)
    loop = np.roll(loop, -starts[0] if source[loop[(starts[0] + 1) % len(loop)]] in border else -starts[1])
    corner, top = int(np.flatnonzero(source[loop] == back)[1]), int(np.flatnonzero(source[loop] == crown)[0])
    frame = _frame(points[loop], corner, top)
    if points[loop[: corner // 2], 0].mean() > 0:  # the neck begins at the subject's right, as seen from outside
        frame[:, 0] = 1 - frame[:, 0]
    weights = _mean_value_weights(points, cut, len(source))
    uv = _settled(weights, len(source), loop, frame)
    for _ in range(ROUNDS):
        stretch = _stretch(points, uv, cut)
        weights = weights @ scipy.sparse.diags_array(1 / stretch)
        uv = _settled(weights, len(source), loop, frame)
    return Layout(MARGIN + (1 - 2 * MARGIN) * uv, cut, source)


def _edges(faces: Faces) -> Int[np.ndarray, "e 2"]:
    """Returns the directed edges of the faces: corner 0 to 1 of all faces, then 1 to 2, then 2 to 0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _border(faces: Faces) -> Int[np.ndarray, " b"]:
    """Returns the vertices of the mesh's only open border, in the order of its directed edges."""
    edges, base = _edges(faces).astype(np.int64), int(faces.max()) + 1
    known = np.unique(edges @ [base, 1])
    open_edges = known[~np.isin(known, edges @ [1, base])]
    following = dict(zip((open_edges // base).tolist(), (open_edges % base).tolist(), strict=True))
    loop = [next(iter(following))] if following else []
    while loop and following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    characteristic = len(np.unique(faces)) - (len(known) + len(open_edges)) // 2 + len(faces)
    if characteristic != 1 or len(loop) != len(open_edges):
        raise NoLayout
    return np.array(loop)


def _path(vertices: Float[np.ndarray, "v 3"], faces: Faces, start: int, end: int) -> Int[np.ndarray, " p"]:
    """Returns a short path along mesh edges, near the symmetry plane; it touches the border only at its start."""
    edges = _edges(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    length *= 1 + np.abs(vertices[edges].mean(axis=1)[:, 0])
    inner = ~np.isin(edges, np.setdiff1d(_border(faces), [start])).any(axis=1)
    graph = scipy.sparse.coo_array((length[inner], edges[inner].T), shape=(len(vertices),) * 2).tocsr()
    _, before = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    path = [end]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


def _cut_open(faces: Faces, count: int, path: Int[np.ndarray, " p"]) -> tuple[Faces, Int[np.ndarray, " n"]]:
    """Cuts the mesh along a path, whose vertices are duplicated. Returns faces, and original indices of the
    vertices."""
    edges = _edges(faces)
    beside = np.flatnonzero(np.isin(edges, path).any(axis=1))
    face_of = dict(zip(map(tuple, edges[beside].tolist()), (beside % len(faces)).tolist(), strict=True))
    steps = {(int(a), int(b)) for a, b in pairwise(path)}
    cut = faces.copy()
    for i, vertex in enumerate(path[:-1].tolist()):
        pending = [face_of[int(path[i + 1]), vertex]]  # to the right of the way
        met: set[int] = set()
        while pending:
            face = pending.pop()
            met.add(face)
            a, b, c = np.roll(faces[face], -int(np.flatnonzero(faces[face] == vertex)[0])).tolist()
            for other, way in ((face_of.get((b, a)), (a, b)), (face_of.get((a, c)), (a, c))):
                if other is not None and other not in met and way not in steps and way[::-1] not in steps:
                    pending.append(other)
        rows = np.array(sorted(met))
        cut[rows] = np.where(faces[rows] == vertex, count + i, cut[rows])
    return cut, np.concatenate([np.arange(count), path[:-1]])


def _frame(loop: Float[np.ndarray, "b 3"], corner: int, top: int) -> Float[np.ndarray, "b 2"]:
    """Returns the border's UV positions: first the neck along the bottom, then the cut along the other sides."""
    ends = np.concatenate([loop, loop[:1]])
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1))])
    neck, crown, whole = walked[corner], walked[top], walked[-1]
    right, left = neck + SIDE_SHARE * (crown - neck), crown + (1 - SIDE_SHARE) * (whole - crown)
    turn = np.interp(walked[:-1], [0, neck, right, crown, left, whole], [0, 1, 2, 2.5, 3, 4])
    side, along = np.divmod(turn, 1.0)
    bulge = BULGE * 4 * along * (1 - along)
    x = np.choose(side.astype(int), [along, 1 - BULGE + bulge, 1 - along, BULGE - bulge])
    y = np.choose(side.astype(int), [1 - BULGE + bulge, 1 - along, BULGE - bulge, along])
    inset = np.choose(side.astype(int), [1, 0, 1, 0])
    x = np.where(inset, BULGE + (1 - 2 * BULGE) * x, x)
    y = np.where(inset, y, BULGE + (1 - 2 * BULGE) * y)
    return np.stack([x, y], axis=1)


def _mean_value_weights(points: Float[np.ndarray, "n 3"], faces: Faces, count: int) -> scipy.sparse.csr_array:
    """Returns the mean-value weights ``(tan(a / 2) + tan(b / 2)) / |ij|`` of vertex i's neighbours j in row i."""
    rows, columns, values = [], [], []
    for k in range(3):
        i, j, other = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        first, second = points[j] - points[i], points[other] - points[i]
        lengths = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
        sine = np.linalg.norm(np.cross(first, second), axis=1)
        cosine = np.einsum("fc,fc->f", first, second)
        half = sine / np.maximum(lengths[0] * lengths[1] + cosine, 1e-12)  # tan(a / 2) = sin a / (1 + cos a)
        for neighbour, length in zip((j, other), lengths, strict=True):
            rows.append(i)
            columns.append(neighbour)
            values.append(half / np.maximum(length, 1e-9))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.coo_array(entries, shape=(count, count)).tocsr()


def _settled(
    weights: scipy.sparse.csr_array, count: int, loop: Int[np.ndarray, " b"], frame: Float[np.ndarray, "b 2"]
) -> Float[np.ndarray, "n 2"]:
    """Returns UV positions in which every inner vertex is the weighted mean of its neighbours."""
    uv = np.zeros((count, 2))
    uv[loop] = frame
    inner = np.setdiff1d(np.arange(len(uv)), loop)
    rows = weights[inner]
    rows = scipy.sparse.diags_array(1 / rows.sum(axis=1)) @ rows
    system = scipy.sparse.eye_array(len(inner)) - rows[:, inner]
    uv[inner] = scipy.sparse.linalg.splu(system.tocsc()).solve(rows[:, loop] @ frame)
    return uv


def _stretch(points: Float[np.ndarray, "n 3"], uv: Float[np.ndarray, "n 2"], faces: Faces) -> Float[np.ndarray, " n"]:
    """Returns the RMS stretch from UV space to the surface around each vertex, relative to that of the whole mesh."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    (s, t), (p, q) = (uv[faces[:, 1]] - uv[faces[:, 0]]).T, (uv[faces[:, 2]] - uv[faces[:, 0]]).T
    determinant = s * q - t * p
    along = ((b - a) * q[:, None] - (c - a) * t[:, None]) / determinant[:, None]
    down = ((c - a) * s[:, None] - (b - a) * p[:, None]) / determinant[:, None]
    square = 0.5 * ((along**2).sum(axis=1) + (down**2).sum(axis=1))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    over = np.bincount(faces.ravel(), np.repeat(area * square, 3), len(points))
    found = np.sqrt(over / np.bincount(faces.ravel(), np.repeat(area, 3), len(points)))
    return found / np.median(found)


def draw_over_layout(
    layout: Layout, values: Float[np.ndarray, "n k"] | UInt8[np.ndarray, "n k"], size: int
) -> Float32[np.ndarray, "s s k"]:
    """Draws values of a UV layout's vertices as an image; texels outside get the nearest value inside."""
    texels, ones = size * layout.uv - 0.5, np.ones(len(layout.uv))
    _, shown = rasterise(texels, ones, layout.faces, size, size)
    drawn = interpolate(shown, texels, ones, layout.faces, np.ascontiguousarray(values, np.float32))
    return spread_texels(drawn, shown >= 0)


def spread_texels(image: Float32[np.ndarray, "s s k"], known: Bool[np.ndarray, "s s"]) -> Float32[np.ndarray, "s s k"]:
    """Returns the image with every unknown texel replaced by the nearest known one."""
    _, labels = cv2.distanceTransformWithLabels(
        (~known).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(labels).astype(np.int32)
    values = np.ones((int(nearest.max()) + 1, image.shape[2]), np.float32)
    values[nearest[known]] = image[known]
    return values[nearest]


@dataclass(frozen=True, slots=True, eq=False)
class ModelLayout:
    """Holds the UV layout of a head model's full-resolution mesh and the neighbours of each vertex."""

    layout: Layout
    around: Neighbourhood


def model_layout(model: HeadModel) -> ModelLayout:
    """Returns the UV layout of a head model, computed from its mean head. Raises NoLayout for a surface that is not one
    piece with one open border."""
    faces = model.levels["full"].faces
    mean = model.vertices(np.zeros(0))

    def make() -> dict[str, np.ndarray]:
        found = unwrap(mean, faces)
        around = Neighbourhood.of(*neighbours(faces, len(mean)))
        return {
            "uv": found.uv,
            "faces": found.faces.astype(np.int32),
            "source": found.source.astype(np.int32),
            "starts": around.starts,
            "indices": around.indices,
            "opposite": around.opposite,
        }

    kept = cached_arrays("uv-layout", (model.mean, faces), make, made_by=(unwrap, neighbours, Neighbourhood))
    layout = Layout(kept["uv"], kept["faces"], kept["source"])
    return ModelLayout(layout, Neighbourhood(kept["starts"], kept["indices"], kept["opposite"]))


@traced
def lay_out_charts(mesh: Mesh, towards: Float[np.ndarray, "v 3"]) -> Layout:
    """Divides a closed mesh (mm, head frame) into UV charts. ``towards``: smoothed normals of the vertices."""
    count, rows = len(mesh.vertices), np.arange(len(mesh.faces))
    seen = [_seen_from(mesh.vertices, direction) for direction in range(6)]
    flat = np.stack([each[0] for each in seen])
    facing = _six(towards).argmax(axis=1)[mesh.faces[:, 0]]
    a, b, c = (flat[facing, mesh.faces[:, k]] for k in range(3))
    turned = rows[np.linalg.det(np.stack([b - a, c - a], axis=1)) >= 0.0]  # y is down
    facing[turned] = _six(face_normals(mesh.vertices, mesh.faces[turned])).argmax(axis=1)
    sheet = np.zeros(len(facing), int)
    for direction, (there, depth) in enumerate(seen):
        chosen, pixels = rows[facing == direction], (there - there.min(axis=0)) / PIXEL_MM
        size = np.ceil(pixels.max(axis=0)).astype(int) + 1
        for number in range(MAX_SHEETS):
            sheet[chosen] = number
            chosen = chosen[_hidden(mesh.faces[chosen], pixels, depth, size)]
            if not len(chosen):
                break
    key = facing + 6 * sheet
    first = np.zeros(count, int)
    first[mesh.faces] = key[:, None]  # a vertex has one place, and others where its triangles lie in several charts
    other = first[mesh.faces] != key[:, None]
    more, which = np.unique((mesh.faces + count * key[:, None])[other], return_inverse=True)
    faces, source = mesh.faces.astype(np.int32), np.concatenate([np.arange(count), more % count]).astype(np.int32)
    faces[other] = count + which
    uv = _packed(flat[np.concatenate([first, more // count]) % 6, source], component_of(faces, len(source)))
    faces.setflags(write=False)  # as a model's: loops are compiled for these
    source.setflags(write=False)
    return Layout(uv, faces, source)


def _six(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6"]:
    """Returns the components of normals along the six directions +x, -x, +y, -y, +z and -z."""
    return np.stack([normals, -normals], axis=2).reshape(-1, 6)


def _seen_from(
    vertices: Float[np.ndarray, "n 3"], direction: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Projects vertices (mm) along a direction. Returns image coordinates (mm; x to the right, y down) and depths."""
    axis, sign = direction // 2, 1.0 - 2.0 * (direction % 2)
    right, up = ((2, 1), (0, 2), (0, 1))[axis]
    turn = sign if axis == 2 else -sign
    return np.stack([turn * vertices[:, right], -vertices[:, up]], axis=1), -sign * vertices[:, axis]


def _hidden(
    faces: Int[np.ndarray, "f 3"],
    pixels: Float[np.ndarray, "v 2"],
    depth: Float[np.ndarray, " v"],
    size: Int[np.ndarray, " 2"],
) -> Int[np.ndarray, " h"]:
    """Returns the indices of the triangles that are hidden behind others in a depth map of ``size`` pixels."""
    first, last = (rasterise(pixels, FAR_MM + sign * depth, faces, size[1], size[0])[1] for sign in (1.0, -1.0))
    hidden = np.unique(last[first != last])
    return hidden if len(hidden) < len(faces) else np.zeros(0, int)


def _packed(flat: Float[np.ndarray, "n 2"], piece: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Places the UV charts in the unit square, all at the same scale; ``piece`` is the chart of each vertex."""
    chart = np.unique(piece, return_inverse=True)[1]
    order = np.argsort(chart, kind="stable")
    starts = np.searchsorted(chart[order], np.arange(chart.max() + 1))
    low, high = (each.reduceat(flat[order], starts, axis=0) for each in (np.minimum, np.maximum))
    side = max(float(np.sqrt((high - low).prod(axis=1).sum())), float((high - low).max()))
    while (corner := _on_shelves(high - low, side)) is None:
        side *= WIDER
    return (flat + (corner - low)[chart]) / side


def _on_shelves(size: Float[np.ndarray, "c 2"], side: float) -> Float[np.ndarray, "c 2"] | None:
    """Returns the upper left corners of UV charts placed in rows, the tallest charts first; None if they do not fit."""
    gap = CHART_MARGIN * side
    corner, (x, y, shelf) = np.empty_like(size), (gap, gap, 0.0)
    for k in np.argsort(-size[:, 1], kind="stable").tolist():
        width, height = size[k]
        if x + width + gap > side:
            x, y, shelf = gap, y + shelf + gap, 0.0
        corner[k], x, shelf = (x, y), x + width + gap, max(shelf, height)
    return corner if y + shelf + gap <= side else None
