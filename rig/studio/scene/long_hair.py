"""Makes hair beyond the shell over the scalp: a sheet that hangs down around the neck, and a bun on the crown."""

import cv2
import numpy as np
from jaxtyping import Float

from rig.mesh import vertex_normals
from rig.studio.scene.anatomy import Anatomy
from rig.studio.scene.curls import curled
from rig.studio.scene.grids import grid_faces
from rig.studio.scene.hair import Hair, HairStyle, grow_strands
from rig.studio.sensor.noise import around

Points = Float[np.ndarray, "n 3"]

ROWS, COLUMNS = 150, 260
FRONT_EDGE_DEG = 112.0  # from the back: just before the ears
TOP_MM = 34.0  # above the ears' openings: there the sheet lies within the shell
INWARD = 0.22  # how fast hair may fall back inwards below the widest place: mm a mm
OUTWARD = 1.3  # how fast it is pushed outwards by shoulders
BUN_ROWS, BUN_COLUMNS = 60, 120
BUN_ELEVATION_DEG = 58.0  # over the back of the head


def hang(shell: Hair, below: Points, body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Makes the sheet of hair that hangs down from the shell to ``style.hanging_mm`` below the openings of the ears.

    Args:
        shell: the hair over the scalp.
        below: vertices that the sheet must stay outside of: head, neck and shirt (head frame, mm).
        body: has the position of the ears.
        style: thickness and length.
        rng: draws locks and ends.
    """
    axis = body.ears - np.array([0.0, 0.0, 12.0]) * body.unit
    angle = np.radians(np.linspace(-FRONT_EDGE_DEG, FRONT_EDGE_DEG, COLUMNS))
    length = (style.hanging_mm + 7.0 * around(rng, 1, COLUMNS, 1, 28)[0] + TOP_MM) * body.unit
    drop = np.linspace(0.0, 1.0, ROWS)[:, None] * length
    radius = _fall(shell, below - axis, axis, style, body.unit, length.max())
    row = drop / length.max() * (ROWS - 1)
    radius = cv2.remap(radius, np.tile(np.arange(COLUMNS, dtype=np.float32), (ROWS, 1)), row.astype(np.float32), 1)
    hung = np.clip(drop / (60.0 * body.unit), 0.0, 1.0)
    radius = radius + hung * (1.6 * around(rng, ROWS, COLUMNS, 3, 34) + 2.0 * around(rng, ROWS, COLUMNS, 2, 11))
    edge = np.clip((np.degrees(np.abs(angle)) - FRONT_EDGE_DEG + 16.0) / 16.0, 0.0, 1.0)
    radius -= 16.0 * body.unit * edge**2  # its front edge turns in towards the neck
    ring = np.stack([np.sin(angle + np.pi), np.zeros_like(angle), np.cos(angle + np.pi)], axis=1)
    sheet = axis + radius[:, :, None] * ring + (TOP_MM * body.unit - drop)[:, :, None] * np.array([0.0, 1.0, 0.0])
    vertices, faces = sheet.reshape(-1, 3), grid_faces(ROWS, COLUMNS, closed=False)[:, ::-1]
    if (vertex_normals(vertices, faces) * np.tile(ring, (ROWS, 1))).sum() < 0:
        faces = faces[:, ::-1]
    points = np.stack([np.tile(angle * 85.0, (ROWS, 1)), drop, np.zeros_like(drop)], axis=-1).reshape(-1, 3)
    shade = 1.0 - 0.25 * np.tile(edge, (ROWS, 1)).ravel()
    if style.curl_mm:
        vertices, curl_shade = curled(
            vertices, vertex_normals(vertices, faces), style.curl_mm, np.ones(sheet[..., 0].size), rng
        )
        shade = shade * curl_shade
    along = np.concatenate([np.diff(sheet, axis=0), np.diff(sheet[-2:], axis=0)]).reshape(-1, 3)
    strands = grow_strands(vertices, faces, along, hung.ravel(), style, rng)
    return Hair(vertices, faces, points, shade, *strands, one_sided=False)


def _fall(
    shell: Hair, below: Points, axis: Float[np.ndarray, " 3"], style: HairStyle, unit: float, length_mm: float
) -> Float[np.ndarray, "r c"]:
    """Returns the radius (float32) by drop and angle: the shell's, then straight down except over what pushes out."""
    hair = _envelope(shell.shell[np.unique(shell.shell_faces)] - axis, unit, length_mm)
    solid = _envelope(below, unit, length_mm)
    step = length_mm / (ROWS - 1)
    drop = np.arange(ROWS) * step
    layer = np.clip(drop / 50.0, 0.0, 1.0) * 0.55 * style.thickness_mm
    sunk = (2.0 + 0.7 * style.curl_mm) * (1.0 - np.clip(drop / 40.0, 0.0, 1.0))
    radius = np.empty((ROWS, COLUMNS), np.float32)
    radius[0] = hair[0] - sunk[0]
    for i in range(1, ROWS):
        pushed = np.maximum(hair[i] - sunk[i], solid[i] + layer[i])
        radius[i] = np.minimum(np.maximum(pushed, radius[i - 1] - INWARD * step), radius[i - 1] + OUTWARD * step)
    return cv2.GaussianBlur(radius, (0, 0), sigmaX=4.0, sigmaY=3.0, borderType=cv2.BORDER_REPLICATE)


def _envelope(points: Points, unit: float, length_mm: float) -> Float[np.ndarray, "r c"]:
    """Returns the outermost radius about the vertical axis by drop and angle (float32), 0 where there is nothing."""
    limit = np.radians(FRONT_EDGE_DEG)
    angle = np.arctan2(-points[:, 0], -points[:, 2])
    row = np.rint((TOP_MM * unit - points[:, 1]) / length_mm * (ROWS - 1)).astype(int)
    column = np.rint((angle + limit) / (2 * limit) * (COLUMNS - 1)).astype(int)
    inside = (row >= 0) & (row < ROWS) & (column >= 0) & (column < COLUMNS)
    radius = np.zeros((ROWS, COLUMNS), np.float32)
    np.maximum.at(
        radius, (row[inside], column[inside]), np.hypot(points[inside, 0], points[inside, 2]).astype(np.float32)
    )
    return np.asarray(cv2.morphologyEx(radius, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)), np.float32)


def knot(shell: Hair, body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Makes a bun of twisted hair on the crown, with the radius ``style.bun_mm``."""
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
    if (vertex_normals(vertices, faces) * (vertices - centre)).sum() < 0:
        faces = faces[:, ::-1]
    points = np.stack([(around_axis + 0.75 * polar) * style.bun_mm, polar * 20.0, np.zeros_like(polar)], axis=-1)
    shade = 1.0 + 0.3 * twist.ravel()
    along = 3.0 * np.cross(outward, vertices - centre) / style.bun_mm
    strands = grow_strands(vertices, faces, along, np.sin(polar).ravel(), style, rng)
    return Hair(vertices, faces, points.reshape(-1, 3), shade, *strands)
