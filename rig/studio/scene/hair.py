"""Creates hair as meshes: an uneven shell over the scalp, and strands that roughen its outline.

The shell of hair has a vertex in each direction of a grid around the middle of the skull. The shell's radius is the
head's radius plus the hair's thickness. Beyond the hairline the shell lies below the skin. Further shapes are a sheet
that hangs around the neck, a bun on the crown, a full beard, and curls, which are winding ridges on the surface.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from rig.errors import InputError
from rig.mesh import Mesh, vertex_normals
from rig.messages.message import compose
from rig.studio.scene.anatomy import Anatomy, Landmarks, directions_of, finer_grid, grid_faces, turned_along
from rig.studio.scene.skin_texture import smoothstep
from rig.studio.sensor.sensor import around, waves

Points = Float[np.ndarray, "n 3"]

SHEET_ROWS, SHEET_COLUMNS = 150, 260
FRONT_EDGE_DEG = 112.0  # from the back: just before the ears
TOP_MM = 34.0  # above the ears' openings: there the sheet lies within the shell
INWARD = 0.22  # how fast hair may fall back inwards below the widest place: mm a mm
OUTWARD = 1.3  # how fast it is pushed outwards by shoulders
BUN_ROWS, BUN_COLUMNS = 60, 120
BUN_ELEVATION_DEG = 58.0  # over the back of the head
SUNK_MM = 2.0  # below the skin where no beard grows
Vertices = Float[np.ndarray, "v 3"]

RIDGE_SHARE = 0.5  # how high curls stand, against the distance from one to the next
VALLEY = 0.45  # tone between curls, where little light falls
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
    """Describes a hair style. ``fringe_mm`` is the distance by which the hairline reaches down over the forehead.
    Curls, hanging hair and bun are absent if their size is 0."""

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
    """Holds one surface of hair (the shell) and the strands on the surface (head frame, mm).

    ``shade`` is each vertex's tone relative to the style's tone. ``roots`` is, for each vertex of a strand, the shell's
    vertex whose irradiance it gets. ``one_sided`` is True if the inside of the shell is never visible.
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
    """Creates the hair over a head's scalp. The hair's vertices are in the head frame (mm)."""
    centre = body.ears + np.array([0.0, 28.0, -6.0]) * body.unit
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(90.0, LOWEST_DEG, ROWS)), np.arange(COLUMNS) * 2 * np.pi / COLUMNS, indexing="ij"
    )
    directions = directions_of(elevation, azimuth)
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
        shell, shade = add_curls(shell, vertex_normals(shell, faces), style.curl_mm, grown.ravel(), rng)
    along = shell[np.minimum(np.arange(len(shell)) + columns, len(shell) - 1)] - shell
    strands = grow_strands(shell, faces, along, np.cos(elevation.ravel()) * (grown.ravel() > 0.5), style, rng)
    return Hair(shell, faces, points, shade, *strands)


def outer_radius(points: Float[np.ndarray, "v 3"], *, open_ears: bool) -> Float[np.ndarray, "r c"]:
    """Returns the largest distance (mm) of points from the origin in each direction of a grid, smoothed. ``open_ears``
    ignores parts as narrow as an ear."""
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
    """Returns the height (mm) of each point above the hairline, positive where hair grows."""
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
    """Creates strands of hair as ribbons of about 3 mm, which leave the shell roughly in the directions ``along``.
    ``weight`` is the density of strands at each vertex. Returns vertices, triangles, texture coordinates and roots of
    the strands, as in ``Hair``."""
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


def add_curls(
    vertices: Vertices, normals: Vertices, curl_mm: float, amount: Float[np.ndarray, " v"], rng: np.random.Generator
) -> tuple[Vertices, Float[np.ndarray, " v"]]:
    """Adds curls to a surface of hair as ridges along the zeros of a random field. Returns the new vertices, and each
    vertex's shade relative to the hair's tone.

    Args:
        vertices: of the smooth surface (mm), a few to each curl.
        normals: unit, outward.
        curl_mm: distance from curl to curl.
        amount: 0 (none) to 1, for each vertex.
        rng: draws the ridges.
    """
    swirl = waves(rng, vertices, 1.6 * curl_mm, 2.6 * curl_mm)
    ridge = np.exp(-((swirl / 0.5) ** 2))
    tuft = 0.3 * waves(rng, vertices, 3.0 * curl_mm, 6.0 * curl_mm)
    height = amount * curl_mm * RIDGE_SHARE * (1.4 * ridge - 0.7 + tuft)
    shade = 1.0 + amount * (VALLEY + (1.15 - VALLEY) * ridge - 1.0)
    return vertices + height[:, None] * normals, shade


def grow_beard(head: Mesh, body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Creates a beard and a moustache as a thicker copy of the lower face (head frame, mm). ``style`` sets thickness,
    curls and strands.

    Raises InputError for a head without landmarks.
    """
    if not body.landmarks:
        raise InputError("beard", [compose("beard-without-landmarks")])
    share = beard_share(head.vertices, body)
    faces = head.faces[(share[head.faces] > 0.0).any(axis=1)]
    normals = vertex_normals(head.vertices, head.faces)
    outward = normals - np.array([0.0, 0.45, 0.0])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    chin = np.exp(-((head.vertices[:, 1] - body.chin_y) ** 2) / (2 * 26.0**2))
    height = share * style.thickness_mm * (0.45 + 0.55 * chin) - SUNK_MM * (1.0 - np.clip(4.0 * share, 0.0, 1.0))
    vertices = head.vertices + height[:, None] * outward
    vertices, shade = add_curls(vertices, normals, style.curl_mm, np.clip(2.0 * share, 0.0, 1.0), rng)
    along = 3.0 * (np.array([0.0, -1.0, 0.15]) + 0.3 * normals)
    strands = grow_strands(vertices, faces, along, (share > 0.3).astype(float), style, rng)
    return Hair(vertices, faces, vertices * (1.0, 0.4, 1.0), shade, *strands)


def beard_share(vertices: Float[np.ndarray, "v 3"], body: Anatomy) -> Float[np.ndarray, " v"]:
    """Returns the density (0 to 1) of a beard at each vertex. Beards grow on jaw, chin and upper lip."""
    marks, (x, y, z) = body.landmarks, vertices.T
    mouth, ears = marks["stomion"], body.ears
    across = (x - mouth[0]) / body.half_breadth
    cheek = mouth[1] + 6.0 + (ears[1] - mouth[1]) * np.minimum(np.abs(across), 1.0) ** 3
    lip = marks["subnasale"][1] - 5.0 - 0.02 * (x - mouth[0]) ** 2  # the moustache's upper edge
    share = smoothstep(4.0, -5.0, y - np.maximum(cheek, lip))
    share *= smoothstep(-26.0, -12.0, y - body.chin_y - 0.3 * np.abs(x - mouth[0]))
    share *= smoothstep(4.0, 14.0, z - ears[2])
    return share * (1.0 - _lips(vertices, marks))


def _lips(vertices: Float[np.ndarray, "v 3"], marks: Landmarks) -> Float[np.ndarray, " v"]:
    right, left = marks["cheilion_right"], marks["cheilion_left"]
    top, bottom = marks["labiale_superius"][1] + 0.5, marks["labiale_inferius"][1] - 3.5
    half = (left[0] - right[0]) / 2
    across = (vertices[:, 0] - (left[0] + right[0]) / 2) / (half + 1.0)
    down = (vertices[:, 1] - (top + bottom) / 2) / (0.5 * (top - bottom))
    return smoothstep(1.35, 0.9, np.hypot(across, down))


def make_hanging_hair(shell: Hair, below: Points, body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Creates the sheet of hair that hangs down from the shell to ``style.hanging_mm`` below the openings of the ears.

    Args:
        shell: the hair over the scalp.
        below: vertices that the sheet must stay outside of: head, neck and shirt (head frame, mm).
        body: has the position of the ears.
        style: thickness and length.
        rng: draws locks and ends.
    """
    axis = body.ears - np.array([0.0, 0.0, 12.0]) * body.unit
    angle = np.radians(np.linspace(-FRONT_EDGE_DEG, FRONT_EDGE_DEG, SHEET_COLUMNS))
    length = (style.hanging_mm + 7.0 * around(rng, 1, SHEET_COLUMNS, 1, 28)[0] + TOP_MM) * body.unit
    drop = np.linspace(0.0, 1.0, SHEET_ROWS)[:, None] * length
    radius = _fall(shell, below - axis, axis, style, body.unit, length.max())
    row = drop / length.max() * (SHEET_ROWS - 1)
    radius = cv2.remap(
        radius, np.tile(np.arange(SHEET_COLUMNS, dtype=np.float32), (SHEET_ROWS, 1)), row.astype(np.float32), 1
    )
    hung = np.clip(drop / (60.0 * body.unit), 0.0, 1.0)
    radius = radius + hung * (
        1.6 * around(rng, SHEET_ROWS, SHEET_COLUMNS, 3, 34) + 2.0 * around(rng, SHEET_ROWS, SHEET_COLUMNS, 2, 11)
    )
    edge = np.clip((np.degrees(np.abs(angle)) - FRONT_EDGE_DEG + 16.0) / 16.0, 0.0, 1.0)
    radius -= 16.0 * body.unit * edge**2  # its front edge turns in towards the neck
    ring = np.stack([np.sin(angle + np.pi), np.zeros_like(angle), np.cos(angle + np.pi)], axis=1)
    sheet = axis + radius[:, :, None] * ring + (TOP_MM * body.unit - drop)[:, :, None] * np.array([0.0, 1.0, 0.0])
    vertices, faces = sheet.reshape(-1, 3), grid_faces(SHEET_ROWS, SHEET_COLUMNS, closed=False)
    faces = turned_along(vertices, faces, np.tile(ring, (SHEET_ROWS, 1)))
    points = np.stack([np.tile(angle * 85.0, (SHEET_ROWS, 1)), drop, np.zeros_like(drop)], axis=-1).reshape(-1, 3)
    shade = 1.0 - 0.25 * np.tile(edge, (SHEET_ROWS, 1)).ravel()
    if style.curl_mm:
        vertices, curl_shade = add_curls(
            vertices, vertex_normals(vertices, faces), style.curl_mm, np.ones(sheet[..., 0].size), rng
        )
        shade = shade * curl_shade
    along = np.concatenate([np.diff(sheet, axis=0), np.diff(sheet[-2:], axis=0)]).reshape(-1, 3)
    strands = grow_strands(vertices, faces, along, hung.ravel(), style, rng)
    return Hair(vertices, faces, points, shade, *strands, one_sided=False)


def _fall(
    shell: Hair, below: Points, axis: Float[np.ndarray, " 3"], style: HairStyle, unit: float, length_mm: float
) -> Float[np.ndarray, "r c"]:
    """Returns the radius (mm, float32) of hanging hair by height and angle. Hair falls straight down except over
    protruding parts."""
    hair = _envelope(shell.shell[np.unique(shell.shell_faces)] - axis, unit, length_mm)
    solid = _envelope(below, unit, length_mm)
    step = length_mm / (SHEET_ROWS - 1)
    drop = np.arange(SHEET_ROWS) * step
    layer = np.clip(drop / 50.0, 0.0, 1.0) * 0.55 * style.thickness_mm
    sunk = (2.0 + 0.7 * style.curl_mm) * (1.0 - np.clip(drop / 40.0, 0.0, 1.0))
    radius = np.empty((SHEET_ROWS, SHEET_COLUMNS), np.float32)
    radius[0] = hair[0] - sunk[0]
    for i in range(1, SHEET_ROWS):
        pushed = np.maximum(hair[i] - sunk[i], solid[i] + layer[i])
        radius[i] = np.minimum(np.maximum(pushed, radius[i - 1] - INWARD * step), radius[i - 1] + OUTWARD * step)
    return cv2.GaussianBlur(radius, (0, 0), sigmaX=4.0, sigmaY=3.0, borderType=cv2.BORDER_REPLICATE)


def _envelope(points: Points, unit: float, length_mm: float) -> Float[np.ndarray, "r c"]:
    """Returns the largest radius (mm, float32) of points around the vertical axis by height and angle, or 0."""
    limit = np.radians(FRONT_EDGE_DEG)
    angle = np.arctan2(-points[:, 0], -points[:, 2])
    row = np.rint((TOP_MM * unit - points[:, 1]) / length_mm * (SHEET_ROWS - 1)).astype(int)
    column = np.rint((angle + limit) / (2 * limit) * (SHEET_COLUMNS - 1)).astype(int)
    inside = (row >= 0) & (row < SHEET_ROWS) & (column >= 0) & (column < SHEET_COLUMNS)
    radius = np.zeros((SHEET_ROWS, SHEET_COLUMNS), np.float32)
    np.maximum.at(
        radius, (row[inside], column[inside]), np.hypot(points[inside, 0], points[inside, 2]).astype(np.float32)
    )
    return np.asarray(cv2.morphologyEx(radius, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)), np.float32)


def make_bun(shell: Hair, body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Creates a bun of twisted hair on the crown, with the radius ``style.bun_mm``."""
    elevation = np.radians(BUN_ELEVATION_DEG)
    outward = np.array([0.0, np.sin(elevation), -np.cos(elevation)])
    arms = shell.shell - body.ears
    seat = shell.shell[np.argmax(arms @ outward - np.linalg.norm(np.cross(arms, outward), axis=1))]
    centre = seat + 0.5 * style.bun_mm * outward
    polar, around_axis = np.meshgrid(
        np.linspace(0.0, np.pi, BUN_ROWS), np.arange(BUN_COLUMNS) * 2 * np.pi / BUN_COLUMNS, indexing="ij"
    )
    twist = np.cos(6 * around_axis + 4.5 * polar) * np.sin(polar)
    lumps = 0.05 * around(rng, BUN_ROWS, BUN_COLUMNS, 4, 8) * np.sin(polar)
    radius = style.bun_mm * (1.0 + 0.06 * twist + lumps)
    side = np.array([1.0, 0.0, 0.0])
    ahead = np.cross(outward, side)
    across, up = radius * np.sin(polar), 0.82 * radius * np.cos(polar)
    offset = [
        (across * np.cos(around_axis))[..., None] * side,
        (across * np.sin(around_axis))[..., None] * ahead,
        up[..., None] * outward,
    ]
    vertices, faces = (centre + sum(offset)).reshape(-1, 3), grid_faces(BUN_ROWS, BUN_COLUMNS)
    faces = turned_along(vertices, faces, vertices - centre)
    points = np.stack([(around_axis + 0.75 * polar) * style.bun_mm, polar * 20.0, np.zeros_like(polar)], axis=-1)
    shade = 1.0 + 0.3 * twist.ravel()
    along = 3.0 * np.cross(outward, vertices - centre) / style.bun_mm
    strands = grow_strands(vertices, faces, along, np.sin(polar).ravel(), style, rng)
    return Hair(vertices, faces, points.reshape(-1, 3), shade, *strands)
