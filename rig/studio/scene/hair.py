"""Makes hair as geometry: a lumpy shell over the scalp, and strands that roughen its outline.

The shell is a grid of directions from the middle of the skull. Its radius is that of the head plus the thickness of the
hair, which decreases to below the skin beyond the hairline.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from rig.mesh import vertex_normals
from rig.studio.scene.anatomy import Anatomy
from rig.studio.scene.curls import curled
from rig.studio.scene.grids import finer_grid, grid_faces
from rig.studio.sensor.noise import around

ROWS, COLUMNS = 84, 176  # from the crown down to 62 degrees below the horizon, and around
CURLED_FINER = 2  # times as many of both under curls
LOWEST_DEG = -62.0
STRAND_POINTS = 4

# The hairline: height above the ears' openings over depth in front of them (mm), behind to front.
HAIRLINE = np.array([(-200, -48), (-72, -48), (-38, -30), (-24, 24), (-8, 36), (12, 36), (20, 6), (30, 2), (38, 40),
                     (52, 62), (75, 84), (200, 88)], float)  # fmt: skip
HAIRLINE_OVER_EARS = np.array([(-200, -55), (-40, -52), (-10, -38), (22, -34), (30, -10), (42, 40), (55, 62), (75, 84),
                               (200, 88)], float)  # fmt: skip


@dataclass(frozen=True, slots=True)
class HairStyle:
    """Describes a hair style. ``fringe_mm`` is how far the hairline comes down over the forehead. Curls, hanging hair
    and bun are 0 for none."""

    thickness_mm: float = 14.0
    over_ears: bool = False
    fringe_mm: float = 0.0
    lumps: float = 0.25  # of the thickness
    strands: int = 4000
    strand_mm: float = 22.0
    stray_mm: float = 2.5  # how far strands stand off
    tone: tuple[float, float, float] = (0.09, 0.05, 0.025)
    curl_mm: float = 0.0  # from curl to curl
    hanging_mm: float = 0.0  # how far hair hangs below the ears' openings
    bun_mm: float = 0.0  # radius of a knot on the crown


@dataclass(frozen=True, slots=True, eq=False)
class Hair:
    """Holds one surface of hair, the shell, and the strands on it (head frame, mm).

    ``shade`` is the tone of each vertex relative to the style's; ``roots`` is, for each vertex of a strand, the vertex
    of the shell whose light it gets; ``one_sided`` says that the inside of the shell is never seen.
    """

    shell: Float[np.ndarray, "v 3"]
    shell_faces: Int[np.ndarray, "f 3"]
    shell_points: Float[np.ndarray, "v 3"]
    shade: Float[np.ndarray, " v"]
    strands: Float[np.ndarray, "s 3"]
    strand_faces: Int[np.ndarray, "g 3"]
    strand_points: Float[np.ndarray, "s 3"]
    roots: Int[np.ndarray, " s"]
    one_sided: bool = True


def grow(vertices: Float[np.ndarray, "v 3"], body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Grows the hair of a head over its scalp. Vertices are in the head frame (mm)."""
    centre = body.ears + np.array([0.0, 28.0, -6.0]) * body.unit
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(90.0, LOWEST_DEG, ROWS)), np.arange(COLUMNS) * 2 * np.pi / COLUMNS, indexing="ij"
    )
    ring = np.cos(elevation)
    directions = np.stack([ring * np.sin(azimuth), np.sin(elevation), ring * np.cos(azimuth)], axis=-1)
    radius = outer_radius(vertices - centre, open_ears=not style.over_ears)
    inside = _inside_hairline(centre + radius[:, :, None] * directions, body, style, rng)
    grown = np.clip(inside / (22.0 * body.unit), 0.0, 1.0)
    grown = grown * grown * (3 - 2 * grown)
    lumps = 1 + style.lumps * (around(rng, ROWS, COLUMNS, 5, 9) + 0.5 * around(rng, ROWS, COLUMNS, 13, 26))
    locks = 0.7 * around(rng, ROWS, COLUMNS, 24, 80)
    crown = np.clip((np.pi / 2 - elevation) / 0.5, 0.0, 1.0)  # all azimuths meet there: no noise
    lumps, locks = 1 + crown * (lumps - 1), crown * locks
    height = np.where(inside > -1.0, 1.0 + grown * (style.thickness_mm * lumps + locks), 0.0)
    height -= 5.0 * np.clip(-inside / 8.0, 0.0, 1.0)
    surface = centre + (radius + height)[:, :, None] * directions
    finer = CURLED_FINER if style.curl_mm else 1
    surface, inside, grown, elevation = (finer_grid(field, finer) for field in (surface, inside, grown, elevation))
    rows, columns = elevation.shape
    shell, faces = surface.reshape(-1, 3), grid_faces(rows, columns)
    faces = faces[(inside.ravel()[faces] > -9.0).any(axis=1)]
    azimuth = np.broadcast_to(np.arange(columns) * 2 * np.pi / columns, elevation.shape)
    points = np.stack([azimuth * 85.0, elevation * 90.0, np.zeros_like(azimuth)], axis=-1).reshape(-1, 3)
    shade = np.ones(len(shell))
    if style.curl_mm:
        shell, shade = curled(shell, vertex_normals(shell, faces), style.curl_mm, grown.ravel(), rng)
    along = shell[np.minimum(np.arange(len(shell)) + columns, len(shell) - 1)] - shell
    strands = grow_strands(shell, faces, along, np.cos(elevation.ravel()) * (grown.ravel() > 0.5), style, rng)
    return Hair(shell, faces, points, shade, *strands)


def outer_radius(points: Float[np.ndarray, "v 3"], *, open_ears: bool) -> Float[np.ndarray, "r c"]:
    """Returns the largest distance (mm) of points from the origin in each direction of the grid, smoothed. With
    ``open_ears``, parts as narrow as an ear are ignored."""
    length = np.linalg.norm(points, axis=1)
    elevation = np.degrees(np.arcsin(points[:, 1] / length))
    row = (90.0 - elevation) / (90.0 - LOWEST_DEG) * (ROWS - 1)
    column = np.arctan2(points[:, 0], points[:, 2]) / (2 * np.pi) * COLUMNS
    inside = row < ROWS - 0.5
    radius = np.zeros((ROWS, COLUMNS), np.float32)
    np.maximum.at(
        radius, (np.rint(row[inside]).astype(int), np.rint(column[inside]).astype(int) % COLUMNS), length[inside]
    )
    margin = COLUMNS // 4
    wrapped = np.concatenate([radius[:, -margin:], radius, radius[:, :margin]], axis=1)
    while (wrapped == 0).any():
        spread = cv2.dilate(wrapped, np.ones((3, 3), np.uint8))
        wrapped = np.where(wrapped > 0, wrapped, spread)
    if open_ears:  # an ear is 15 degrees wide: erase what is narrower than 30
        wrapped = cv2.morphologyEx(wrapped, cv2.MORPH_OPEN, np.ones((1, 15), np.uint8))
    smooth = cv2.GaussianBlur(wrapped, (0, 0), 1.5)[:, margin:-margin].astype(float)
    smooth[0] = smooth[0].mean()
    return smooth


def _inside_hairline(
    surface: Float[np.ndarray, "r c 3"], body: Anatomy, style: HairStyle, rng: np.random.Generator
) -> Float[np.ndarray, "r c"]:
    """Returns the height above the hairline, mm; positive under hair."""
    line = HAIRLINE_OVER_EARS if style.over_ears else HAIRLINE
    relative = (surface - body.ears) / body.unit
    front = np.clip((relative[:, :, 2] - 35.0) / 40.0, 0.0, 1.0)
    height = np.interp(relative[:, :, 2], line[:, 0], line[:, 1]) - style.fringe_mm * front
    ragged = 2.5 * around(rng, ROWS, COLUMNS, 20, 44)
    return (relative[:, :, 1] - height + ragged) * body.unit


def grow_strands(
    shell: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    along: Float[np.ndarray, "v 3"],
    weight: Float[np.ndarray, " v"],
    style: HairStyle,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "s 3"], Int[np.ndarray, "g 3"], Float[np.ndarray, "s 3"], Int[np.ndarray, " s"]]:
    """Grows strands of hair: ribbons that leave the shell mostly in the directions ``along`` (about 3 mm long).
    ``weight`` sets how densely they grow at each vertex. Returns their vertices, triangles, texture coordinates and
    roots, as ``Hair`` holds them."""
    count = style.strands
    weight = weight.copy()
    weight[np.setdiff1d(np.arange(len(shell)), faces)] = 0.0
    if count == 0 or weight.sum() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros(0, int)
    root = rng.choice(len(shell), count, p=weight / weight.sum())
    normals = vertex_normals(shell, faces)[root]
    along = along[root] + rng.normal(0, 1.2, (count, 3))
    along -= (along * normals).sum(1, keepdims=True) * normals
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-9
    start = shell[root] + rng.normal(0, 1.5, (count, 3)) - 1.5 * normals
    length = style.strand_mm * rng.uniform(0.4, 1.3, (count, 1))
    lift = style.stray_mm * rng.exponential(1.0, (count, 1)).clip(0, 4)
    side = np.cross(along, normals + rng.normal(0, 0.7, (count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-9
    bend = rng.normal(0, 0.18, (count, 1)) * length * np.cross(along, normals)
    middle, half = [], []
    for t in np.linspace(0, 1, STRAND_POINTS):
        arch = 4 * t * (1 - 0.6 * t)  # up, and bending back towards the head, which curves away
        middle.append(
            start + t * length * along + lift * arch * normals - 0.0035 * (t * length) ** 2 * normals + t * t * bend
        )
        half.append(side * (0.24 * (1 - 0.75 * t)))
    left, right = np.array(middle) - half, np.array(middle) + half
    vertices = np.stack([left, right], axis=2).transpose(1, 0, 2, 3).reshape(-1, 3)
    step = np.arange(STRAND_POINTS - 1) * 2
    quad = np.concatenate([np.stack([step, step + 1, step + 2], 1), np.stack([step + 1, step + 3, step + 2], 1)])
    ribbons = (np.arange(count) * 2 * STRAND_POINTS)[:, None, None] + quad
    points = np.zeros((count, STRAND_POINTS, 2, 3))
    points[..., 0] = rng.uniform(0, 500, (count, 1, 1))
    points[..., 1] = (np.linspace(0, 1, STRAND_POINTS) * length)[:, :, None]
    return vertices, ribbons.reshape(-1, 3), points.reshape(-1, 3), np.repeat(root, 2 * STRAND_POINTS)
