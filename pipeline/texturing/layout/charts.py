"""Lays a closed surface flat in charts, for the bust's texture.

Each triangle goes to the one of six directions (along the head's axes) that its surroundings face, and is drawn as it
is seen from there. Where one sheet lies behind another (an ear before the head), the hidden one goes to a chart of its
own. Charts are packed on shelves.
"""

import numpy as np
from jaxtyping import Float, Int

from pipeline.compute.trace import traced
from pipeline.fusion.grid_kernels import component_of
from pipeline.geometry.raster_kernels import rasterise
from pipeline.texturing.layout.uv_unwrap import Layout
from rig.mesh import Mesh, face_normals

PIXEL_MM = 0.5  # of the picture that tells which sheet hides another
FAR_MM = 10_000.0  # of the camera that draws it
MAX_SHEETS = 8  # behind each other; in a tangle of curls the last ones share their texels
MARGIN = 1 / 512  # of the texture's side, between charts
WIDER = 1.02  # by what the square grows until all charts fit


@traced
def lay_out_charts(mesh: Mesh, towards: Float[np.ndarray, "v 3"]) -> Layout:
    """Returns the layout of a closed mesh (mm, the head's axes); ``towards``: normals of vertices' surroundings."""
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
    """Returns the components of normals towards +x, -x, +y, -y, +z and -z."""
    return np.stack([normals, -normals], axis=2).reshape(-1, 6)


def _seen_from(
    vertices: Float[np.ndarray, "n 3"], direction: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Returns the vertices (mm; x to the right, y down) as they are seen from a direction, and their depth."""
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
    """Returns the rows of the triangles that lie behind others in a picture of that ``size``."""
    first, last = (rasterise(pixels, FAR_MM + sign * depth, faces, size[1], size[0])[1] for sign in (1.0, -1.0))
    hidden = np.unique(last[first != last])
    return hidden if len(hidden) < len(faces) else np.zeros(0, int)


def _packed(flat: Float[np.ndarray, "n 2"], piece: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Places the charts, each a ``piece`` of the layout, in the unit square, all at one scale."""
    chart = np.unique(piece, return_inverse=True)[1]
    order = np.argsort(chart, kind="stable")
    starts = np.searchsorted(chart[order], np.arange(chart.max() + 1))
    low, high = (each.reduceat(flat[order], starts, axis=0) for each in (np.minimum, np.maximum))
    side = max(float(np.sqrt((high - low).prod(axis=1).sum())), float((high - low).max()))
    while (corner := _on_shelves(high - low, side)) is None:
        side *= WIDER
    return (flat + (corner - low)[chart]) / side


def _on_shelves(size: Float[np.ndarray, "c 2"], side: float) -> Float[np.ndarray, "c 2"] | None:
    """Returns the upper left corners of charts placed side by side, the highest first; None if they do not fit."""
    gap = MARGIN * side
    corner, (x, y, shelf) = np.empty_like(size), (gap, gap, 0.0)
    for k in np.argsort(-size[:, 1], kind="stable").tolist():
        width, height = size[k]
        if x + width + gap > side:
            x, y, shelf = gap, y + shelf + gap, 0.0
        corner[k], x, shelf = (x, y), x + width + gap, max(shelf, height)
    return corner if y + shelf + gap <= side else None
