"""Rows of teeth in their gums, swept along an arch: one closed surface for each jaw.

Crowns have the mean sizes of permanent teeth (M. Ash and S. Nelson, *Wheeler's Dental Anatomy*), seven
on each side; the arch is whoever's calls. A column of the surface is a cross-section, from the gum's outer fold
over the crown to its inner fold.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from rig.mesh import Mesh

TOOTH, BETWEEN, GUM = (226, 216, 196), (176, 156, 132), (186, 104, 102)  # sRGB
ACROSS = np.array([-1.0, -0.9, -0.65, -0.33, 0.0, 0.33, 0.65, 0.9])  # columns of a tooth; the next one's first follows
GUM_MM = 5.0  # of gum that is modelled above a crown
EMBRASURE_MM = 1.0  # by which crowns are thinner on either face where they touch
PAPILLA = 0.3  # of a crown's height that gum fills between crowns
SMOOTH = 6.0  # columns over which what differs between crowns fades in the gum
OUTER, INNER = (1.0, 0.75, 0.5, 0.25, 0.06), (0.06, 0.35, 0.7, 1.0)  # rows: shares of the way from edge to gum


@dataclass(frozen=True, slots=True)
class Crown:
    """Holds the size of a crown, mm: across the arch's line, along the tooth, and from cheek to tongue at the gum and
    at the edge; and the depths (mm) of its edge's corners and of the groove in its table."""

    width: float
    height: float
    depth: float
    edge: float
    corner: float
    groove: float = 0.0


UPPER = (
    Crown(8.5, 10.5, 7.0, 1.6, 0.5),
    Crown(6.5, 9.0, 6.0, 1.5, 0.7),
    Crown(7.5, 10.0, 8.0, 2.0, 1.6),
    Crown(7.0, 8.5, 9.0, 5.0, 1.2, 1.2),
    Crown(7.0, 8.5, 9.0, 5.0, 1.0, 1.2),
    Crown(10.0, 7.5, 11.0, 7.0, 0.8, 1.0),
    Crown(9.0, 7.0, 11.0, 7.0, 0.8, 1.0),
)  # from the middle
LOWER = (
    Crown(5.0, 9.0, 6.0, 1.4, 0.3),
    Crown(5.5, 9.5, 6.5, 1.4, 0.4),
    Crown(7.0, 11.0, 7.5, 1.8, 1.5),
    Crown(7.0, 8.5, 7.5, 4.0, 1.2, 1.2),
    Crown(7.0, 8.0, 8.0, 4.5, 1.0, 1.2),
    Crown(11.0, 7.5, 10.5, 6.5, 0.8, 1.0),
    Crown(10.5, 7.0, 10.0, 6.5, 0.8, 1.0),
)


def row_of_teeth(line: Float[np.ndarray, "k 3"], crowns: tuple[Crown, ...], *, up: float) -> Mesh:
    """Returns the teeth of a jaw and their gum, coloured.

    Args:
        line: the edges' line, from right to left, symmetric, mm (head frame); teeth stand on its inner side.
        crowns: from the middle to the back.
        up: 1 where roots are above crowns, -1 where they are below.
    """
    along, sizes, across = _columns(crowns)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    spline = CubicSpline(length - 0.5 * length[-1], line)
    base, tangent = spline(along), spline(along, 1)
    outward = np.stack([-tangent[:, 2], np.zeros(len(along)), tangent[:, 0]], axis=1)
    outward = gaussian_filter1d(outward, 1.5 * SMOOTH, axis=0, mode="nearest")
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    profile, colours = _profile(sizes, np.abs(across))
    vertices = base[:, None] + profile[..., :1] * outward[:, None] + profile[..., 1:] * np.array([0.0, up, 0.0])
    vertices, faces, colours = _closed(vertices, colours)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.einsum("fx,fx->", np.cross(a, b), c)
    return Mesh(vertices, faces if volume > 0.0 else faces[:, ::-1].copy(), colours)


def _columns(
    crowns: tuple[Crown, ...],
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, "c 6"], Float[np.ndarray, " c"]]:
    """Returns where each column stands on the line (0 is its middle), the sizes of its crown, and where on that."""
    both = [*reversed(crowns), *crowns]
    width = np.array([crown.width for crown in both])
    middle = np.cumsum(width) - 0.5 * width - 0.5 * width.sum()
    table = np.array([[c.width, c.height, c.depth, c.edge, c.corner, c.groove] for c in both])
    along = (middle[:, None] + 0.5 * width[:, None] * ACROSS).ravel()
    sizes, across = np.repeat(table, len(ACROSS), axis=0), np.tile(ACROSS, len(both))
    starts = np.arange(len(ACROSS), len(along), len(ACROSS))  # columns that two crowns share
    sizes[starts] = 0.5 * (sizes[starts] + sizes[starts - 1])
    return np.append(along, 0.5 * width.sum()), np.concatenate([sizes, table[-1:]]), np.append(across, 1.0)


def _profile(
    sizes: Float[np.ndarray, "c 6"], across: Float[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, "c r 2"], UInt8[np.ndarray, "c r 3"]]:
    """Returns each column's points, outwards and towards the root from the edge's line (mm), and their colours."""
    _, height, depth, edge, corner, groove = sizes.T
    depth, fold = (gaussian_filter1d(each, SMOOTH, mode="nearest") for each in (depth, height + GUM_MM))
    thinner, behind = EMBRASURE_MM * across**4, 0.15 * np.minimum(edge, 5.0) * across**4
    molar = groove > 0.0
    dip = corner * np.where(molar & (edge > 6.0), 0.5 + 0.5 * np.cos(2.0 * np.pi * across), across**3)
    gum = height * (1.0 - PAPILLA * across**2)
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(outward: np.ndarray, rootward: np.ndarray, colour: tuple[int, int, int]) -> None:
        share = np.clip((across - 0.8) / 0.2, 0.0, 1.0)[:, None] if colour == TOOTH else 0.0
        rows.append((outward, rootward, (1.0 - share) * np.array(colour) + share * np.array(BETWEEN)))

    gum_thinner = 0.3 * thinner
    add(-0.2 * depth, fold, GUM)
    add(0.5 - gum_thinner, fold - 0.5 * GUM_MM, GUM)
    add(0.5 - gum_thinner, gum + 1.0, GUM)
    add(0.3 - np.minimum(gum_thinner + 0.1, thinner), gum + 0.3, GUM)
    for share in OUTER:
        bulge = 0.4 * np.sin(np.pi * share) - 0.5 * (1.0 - share) ** 2
        add(bulge - thinner, dip + share * (gum - dip), TOOTH)
    front, back = -0.5 - thinner, behind - 0.5 - edge
    for share, sunk in ((0.25, 0.0 * dip), (0.5, groove), (0.75, 0.3 * corner)):
        add(front + share * (back - front), dip + sunk, TOOTH)
    for share in INNER:
        thick = 0.5 + edge + (depth - 0.5 - edge) * share**0.8
        add(behind - thick, dip + share * (gum - dip), TOOTH)
    add(gum_thinner - depth - 0.4, gum + 0.3, GUM)
    add(gum_thinner - depth - 0.6, fold - 0.5 * GUM_MM, GUM)
    add(-0.8 * depth, fold, GUM)
    points = np.stack([np.stack([out, root], axis=1) for out, root, _ in rows], axis=1)
    shape = (len(across), 3)
    colours = np.stack([np.broadcast_to(colour, shape) for _, _, colour in rows], axis=1)
    return points, np.round(colours).astype(np.uint8)


def _closed(
    grid: Float[np.ndarray, "c r 3"], colours: UInt8[np.ndarray, "c r 3"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], UInt8[np.ndarray, "v 3"]]:
    """Returns the surface through columns of points, each a closed loop, with both ends filled."""
    columns, rows = grid.shape[:2]
    number = np.arange(columns * rows).reshape(columns, rows)
    a, b = number[:-1], number[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    sides = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3), np.stack([a, c, d], 2).reshape(-1, 3)])
    first, last = number[0], number[-1]
    ends = [columns * rows, columns * rows + 1]
    caps = [
        np.stack([np.full(rows, ends[0]), first, np.roll(first, -1)], axis=1),
        np.stack([np.full(rows, ends[1]), np.roll(last, -1), last], axis=1),
    ]
    vertices = np.concatenate([grid.reshape(-1, 3), grid[[0, -1]].mean(axis=1)])
    coloured = np.concatenate([colours.reshape(-1, 3), np.array([GUM, GUM], np.uint8)])
    return vertices, np.concatenate([sides, *caps]).astype(np.int32), coloured
