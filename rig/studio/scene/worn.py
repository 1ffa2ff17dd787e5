"""Creates meshes of clothing: a shirt with shoulders for a head whose mesh ends at the neck, a cap with a visor, a
tight cap, and glasses without lenses."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from rig.errors import InputError
from rig.mesh import Mesh, boundary_edges, face_normals, vertex_normals
from rig.messages.message import compose
from rig.studio.scene.anatomy import Anatomy, directions_of, grid_faces, turned_along
from rig.studio.scene.hair import COLUMNS, LOWEST_DEG, ROWS, outer_radius
from rig.studio.sensor.sensor import around

CLOTH_COLUMNS = 120
# Rings from the collar down: drop below the collar, half width, half depth (mm); the first two follow the neck.
RINGS = (
    (0, 0, 0),
    (14, 0, 0),
    (34, 112, 78),
    (52, 150, 90),
    (76, 183, 100),
    (110, 205, 110),
    (170, 214, 118),
    (330, 216, 122),
)
BUST_MM = 95.0  # a mesh that reaches this far below the collar brings its own shoulders
# The edge: height above the ears' openings over depth in front of them (mm), behind to front. Ears stay free.
EDGE = np.array([(-200, -32), (-62, -28), (-38, 14), (-22, 40), (16, 42), (34, 50), (60, 62), (200, 70)], float)
SUNK_MM = 2.0  # of the edge below the skin
CREASED_MM = 22.0  # from the edge, over which folds fade
RIDGES = (11, 17, 29)  # folds around the head, added up
Vertices = Float[np.ndarray, "v 3"]
Vector = Float[np.ndarray, " 3"]

Surface = tuple[Vertices, Int[np.ndarray, "f 3"]]
AnySurface = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]  # in lists, where each has its own counts

CAP_ROWS = 60
CAP_AHEAD, CAP_BEHIND = (92.0, 76.0), (-100.0, 0.0)  # depth and height of the rim before and behind the ears, mm
CAP_MM = 4.0  # from hair to cloth
PANELS, SEAM_MM = 6, 0.9
VISOR_DEG, VISOR_MM, VISOR_THICK_MM = 62.0, 66.0, 2.4
RIM_MM, TEMPLE_MM = 1.7, 2.0  # radii of the tubes of glasses
SIDES = 10  # of a tube


@dataclass(frozen=True, slots=True)
class TightCap:
    """Describes a tight cap by its albedo (linear RGB), its thickness, the height and darkness of the folds near its
    edge, and whether it shines like silicone."""

    colour: tuple[float, float, float]
    thickness_mm: float = 1.0
    folds_mm: float = 0.0
    creases: float = 0.0
    glossy: bool = True


def lay_cap(
    head: Mesh, body: Anatomy, cap: TightCap, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "v 3"]]:
    """Creates a tight cap on a head (head frame, mm). Returns its vertices, triangles, and linear RGB albedo by
    vertex."""
    above = above_edge_mm(head.vertices, body)
    faces = head.faces[(above[head.faces] > 0.0).any(axis=1)]
    rows, corners = np.unique(faces, return_inverse=True)
    out, normals = head.vertices[rows] - body.ears, vertex_normals(head.vertices, head.faces)[rows]
    turn, above = np.arctan2(out[:, 0], out[:, 2]), above[rows]
    waves = sum(np.sin(count * turn + rng.uniform(0.0, 2.0 * np.pi)) for count in RIDGES) / len(RIDGES)
    fold = np.clip(waves, 0.0, 1.0) * np.exp(-np.maximum(above, 0.0) / CREASED_MM)
    height = np.where(above > 0.0, cap.thickness_mm + cap.folds_mm * fold, -SUNK_MM)
    shade = 1.0 - cap.creases * (np.abs(waves) * np.exp(-np.maximum(above, 0.0) / (2.0 * CREASED_MM)))
    albedo = np.array(cap.colour) * shade[:, None]
    return head.vertices[rows] + height[:, None] * normals, corners.reshape(-1, 3), albedo


def above_edge_mm(vertices: Float[np.ndarray, "v 3"], body: Anatomy) -> Float[np.ndarray, " v"]:
    """Returns the height (mm) of each vertex of a head above the edge of a cap, negative below the edge."""
    relative = (vertices - body.ears) / body.unit
    return (relative[:, 1] - np.interp(relative[:, 2], EDGE[:, 0], EDGE[:, 1])) * body.unit


def make_cap(head: Float[np.ndarray, "n 3"], hair: Float[np.ndarray, "m 3"] | None, body: Anatomy) -> Surface:
    """Creates a cap that fits over a head and its hair (head frame, mm)."""
    centre = body.ears + np.array([0.0, 28.0, -6.0]) * body.unit
    radius = outer_radius(head - centre, open_ears=True)
    if hair is not None:
        radius = np.maximum(radius, outer_radius(hair - centre, open_ears=False))
    azimuth = np.arange(COLUMNS) * 2 * np.pi / COLUMNS
    elevation = np.radians(np.linspace(90.0, LOWEST_DEG, ROWS))
    directions = directions_of(np.repeat(elevation[:, None], COLUMNS, axis=1), azimuth[None, :])
    surface = (centre + (radius + CAP_MM * body.unit)[:, :, None] * directions - body.ears) / body.unit
    slope = (CAP_AHEAD[1] - CAP_BEHIND[1]) / (CAP_AHEAD[0] - CAP_BEHIND[0])
    above = surface[:, :, 1] - (CAP_AHEAD[1] + slope * (surface[:, :, 2] - CAP_AHEAD[0]))
    crown = np.empty((CAP_ROWS, COLUMNS, 3))
    for c in range(COLUMNS):  # down to where this meridian meets the plane of the rim
        lowest = np.interp(0.0, -above[:, c], np.arange(ROWS))
        at = np.linspace(0.0, lowest, CAP_ROWS)
        for axis in range(3):
            crown[:, c, axis] = np.interp(at, np.arange(ROWS), surface[:, c, axis])
    crown = body.ears + body.unit * crown
    seam = np.exp(-((((azimuth * PANELS / (2 * np.pi) + 0.5) % 1.0 - 0.5) * 30.0) ** 2))
    crown -= SEAM_MM * (seam[:, None] * directions[ROWS // 3])[None] * np.linspace(0, 1, CAP_ROWS)[:, None, None]
    hem = crown[-1:] - 5.0 * body.unit * directions[ROWS // 2][None]
    grid = np.concatenate([crown, hem])
    vertices, faces = grid.reshape(-1, 3), grid_faces(CAP_ROWS + 1, COLUMNS)
    shell = vertices, turned_along(vertices, faces, vertices - centre)
    return join_surfaces([shell, _visor(crown[-1], azimuth, body)])


def _visor(rim: Float[np.ndarray, "c 3"], azimuth: Float[np.ndarray, " c"], body: Anatomy) -> Surface:
    """Creates the visor of a cap as two sheets that bend down at both sides and join at the front edge."""
    turn = (azimuth + np.pi) % (2 * np.pi) - np.pi
    front = np.flatnonzero(np.abs(turn) < np.radians(VISOR_DEG))
    front = front[np.argsort(turn[front])]
    share = turn[front] / np.radians(VISOR_DEG)
    reach = VISOR_MM * body.unit * np.sqrt(np.maximum(1.0 - share**4, 0.0))
    t = np.concatenate([np.linspace(-0.06, 1.0, 16), [1.0]])[:, None]
    drop = 6.0 + 10.0 * t**2 + 12.0 * share**2 * t
    top = rim[front] + np.stack([0.06 * reach * share * t, -drop * t * body.unit, reach * t], axis=-1)
    under = top - np.array([0.0, VISOR_THICK_MM, 0.0])
    grid = np.concatenate([top[:-1], under[-1:], under[-2::-1]])
    faces = grid_faces(len(grid), len(front), closed=False)
    vertices = grid.reshape(-1, 3)
    upward = face_normals(vertices, faces)[: 10 * len(front), 1].sum()
    return vertices, faces if upward > 0 else faces[:, ::-1]


def make_glasses(head: Vertices, body: Anatomy) -> AnySurface:
    """Creates glasses from a head's landmarks: two rims, a bridge and two temples (head frame, mm).

    Raises InputError for a head without landmarks.
    """
    marks = body.landmarks
    if not marks:
        raise InputError("glasses", [compose("glasses-without-landmarks")])
    plane_z = max(float(marks["glabella"][2]) + 2.0, float(marks["endocanthion_left"][2]) + 16.0)
    pieces, inner = [], {}
    for side, sign in (("right", -1.0), ("left", 1.0)):
        corner, nose = marks[f"exocanthion_{side}"], marks[f"endocanthion_{side}"]
        centre = np.array([(corner[0] + nose[0]) / 2 + 1.5 * sign, (corner[1] + nose[1]) / 2 - 3.0, plane_z])
        turn = np.arange(72) * 2 * np.pi / 72
        ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        ring = np.sign(ring) * np.abs(ring) ** 0.75 * (25.0, 19.0)  # a rounded rectangle
        path = centre + np.column_stack([sign * ring, -0.004 * (ring[:, 0] + 25.0) ** 2])
        pieces.append(_tube(path, RIM_MM, np.array([0.0, 0.0, 1.0]), closed=True))
        inner[side] = path[np.argmin(sign * path[:, 0] + 0.3 * np.abs(path[:, 1] - centre[1] - 8.0))]
        outer = path[np.argmax(sign * path[:, 0] + 0.2 * path[:, 1])]
        pieces.append(_tube(_temple(head, body, outer, sign), TEMPLE_MM, np.array([0.0, 1.0, 0.0]), closed=False))
    t = np.linspace(0.0, 1.0, 16)[:, None]
    arch = 4 * t * (1 - t) * np.array([0.0, 3.0, 5.0])
    bridge = (1 - t) * inner["right"] + t * inner["left"] + arch
    return join_surfaces([*pieces, _tube(bridge, RIM_MM, np.array([0.0, 0.0, 1.0]), closed=False)])


def _temple(head: Vertices, body: Anatomy, start: Vector, sign: float) -> Float[np.ndarray, "n 3"]:
    """Returns the path (mm) of one arm of glasses, from the rim back over the ear and down behind the ear."""
    over = body.ears + np.array([0.0, 14.0, -4.0]) * body.unit
    between = np.abs(head[:, 1] - over[1]) < 6.0
    between &= (head[:, 2] > over[2] + 10.0) & (head[:, 2] < start[2] - 15.0)
    beside = float((sign * head[between, 0]).max()) + 1.5 if between.any() else body.half_breadth
    over[0] = sign * max(beside, body.half_breadth - 2.0)
    knee = start + np.array([sign * 4.0, 0.0, -4.0])
    knee[0] = sign * max(sign * knee[0], beside)
    end = over + np.array([-3.0 * sign, -26.0, -22.0]) * body.unit
    corners = np.array([start, knee, over, end])
    t = np.concatenate([np.linspace(0, 1, 5)[:-1], np.linspace(1, 2, 24)[:-1], np.linspace(2, 3, 10)])
    return np.stack([np.interp(t, np.arange(4), corners[:, axis]) for axis in range(3)], axis=1)


def _tube(path: Float[np.ndarray, "n 3"], radius_mm: float, reference: Vector, *, closed: bool) -> Surface:
    """Creates a round tube around a path. The direction ``reference`` must not be parallel to the path."""
    tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if closed else np.gradient(path, axis=0)
    across = np.cross(tangent, reference)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(across, tangent)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    turn = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * other[:, None]
    grid = path[:, None] + radius_mm * ring
    if closed:
        grid = np.concatenate([grid, grid[:1]])
    else:  # a point closes each end
        grid = np.concatenate([np.repeat(path[:1, None], SIDES, 1), grid, np.repeat(path[-1:, None], SIDES, 1)])
    vertices, faces = grid.reshape(-1, 3), grid_faces(len(grid), SIDES)
    middle = np.concatenate([path, path[:1]]) if closed else np.concatenate([path[:1], path, path[-1:]])
    return vertices, turned_along(vertices, faces, vertices - np.repeat(middle, SIDES, axis=0))


def join_surfaces(surfaces: list[AnySurface]) -> AnySurface:
    """Merges several surfaces into one, with renumbered triangles."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in surfaces])
    faces = [faces + start for (_, faces), start in zip(surfaces, starts[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(faces)


def make_shirt(
    head: Mesh, body: Anatomy, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "s 3"], Int[np.ndarray, "f 3"]] | None:
    """Creates a shirt for a head whose mesh ends at the neck, as vertices (head frame, mm) and outward faces. Returns
    None for a mesh with shoulders."""
    vertices = head.vertices
    collar_y = body.chin_y - 27.0 * body.unit
    if vertices[:, 1].min() < collar_y - BUST_MM or vertices[:, 1].min() > collar_y:
        return None
    rim = vertices[np.unique(boundary_edges(head.faces))]
    rim = rim[rim[:, 1] < body.chin_y]
    if len(rim):  # the cut through the neck must not show
        collar_y = min(max(collar_y, float(rim[:, 1].max()) + 7.0), body.chin_y - 12.0)
    neck = vertices[np.abs(vertices[:, 1] - collar_y) < 8.0]
    axis = (neck.min(axis=0) + neck.max(axis=0)) / 2
    rings = _rings(vertices, collar_y, axis)
    grid = _denser(rings)
    folds = 2.2 * around(rng, len(grid), CLOTH_COLUMNS, 9, 16) + 0.8 * around(rng, len(grid), CLOTH_COLUMNS, 18, 40)
    out = (grid - axis) * (1, 0, 1)
    out /= np.linalg.norm(out, axis=2, keepdims=True)
    grid = grid + out * (folds * np.clip(np.linspace(-0.3, 1, len(grid)), 0.0, 1)[:, None])[:, :, None]
    points = grid.reshape(-1, 3)
    return points, turned_along(points, grid_faces(len(grid), CLOTH_COLUMNS), out.reshape(-1, 3))


def _rings(
    vertices: Float[np.ndarray, "v 3"], collar_y: float, axis: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "r c 3"]:
    """Returns the rings of a shirt's vertices (mm) from the collar down. Each ring encloses the ring above."""
    angle = np.arange(CLOTH_COLUMNS) * 2 * np.pi / CLOTH_COLUMNS
    across, ahead = np.sin(angle), np.cos(angle)
    rings, reach = [], np.zeros(CLOTH_COLUMNS)
    for drop, half_width, half_depth in RINGS:
        reach = np.maximum(reach, _neck(vertices, collar_y - drop, axis))
        if half_width:
            planned = ((np.abs(across) / half_width) ** 2.5 + (np.abs(ahead) / half_depth) ** 2.5) ** (-1 / 2.5)
            reach = np.maximum(reach, planned)
        y = collar_y - drop - 9.0 * np.maximum(ahead, 0) * (drop < 20)  # the neckline is lower in front
        rings.append(np.stack([axis[0] + reach * across, y, axis[2] + reach * ahead], axis=1))
    return np.array(rings)


def _neck(vertices: Float[np.ndarray, "v 3"], y: float, axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " c"]:
    """Returns the radius (mm) of the neck by angle, with a margin for the cloth, or 0 below the mesh."""
    near = vertices[np.abs(vertices[:, 1] - y) < 9.0] - axis
    radius = np.zeros(CLOTH_COLUMNS, np.float32)
    if len(near) < 20:
        return radius.astype(float)
    column = np.rint(np.arctan2(near[:, 0], near[:, 2]) / (2 * np.pi) * CLOTH_COLUMNS).astype(int) % CLOTH_COLUMNS
    np.maximum.at(radius, column, np.hypot(near[:, 0], near[:, 2]))
    wrapped = np.tile(radius, 3)[None]
    wrapped = cv2.GaussianBlur(cv2.dilate(wrapped, np.ones((1, 9), np.uint8)), (0, 0), 2.0)
    return wrapped[0, CLOTH_COLUMNS : 2 * CLOTH_COLUMNS] + 3.0


def _denser(rings: Float[np.ndarray, "r c 3"]) -> Float[np.ndarray, "n c 3"]:
    at = np.linspace(0, len(rings) - 1, 8 * len(rings))
    flat = rings.reshape(len(rings), -1)
    smooth = np.stack([np.interp(at, np.arange(len(rings)), column) for column in flat.T], axis=1)
    kernel = np.array([1, 2, 3, 2, 1]) / 9.0
    padded = np.concatenate([2 * smooth[:1] - smooth[2:0:-1], smooth, 2 * smooth[-1:] - smooth[-2:-4:-1]])
    blurred = sum(kernel[i] * padded[i : i + len(smooth)] for i in range(5))
    return np.asarray(blurred).reshape(len(at), -1, 3)
