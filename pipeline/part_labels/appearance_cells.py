"""Computes features that distinguish skin, hair and clothes on a coarse grid of every photograph: colour, fine
structure, and position on the head.

A cell of this grid is a square of pixels, about two millimetres wide on the subject for any resolution of the camera.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.projection import camera_depths
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.imaging.colour_balance import balance
from rig.camera import Camera
from rig.colour_space import linear_from_srgb
from rig.mesh import Mesh
from rig.rig import Rig

Vector = Float[np.ndarray, " 3"]

BALANCE_VERTICES = 3000  # vertices of the face that estimate the cameras' gains
CHEEK_INSIDE_MM, CHEEK_MARGIN_MM = 12.0, 3.0  # from the border of the face, and above the nose's lower end
DOWNWARD = (-0.25, -0.5)  # cosine between normal and up: below jaw and chin, where light from above leaves skin dark
MIN_FACING = 0.5  # cosine: flatter skin shines
HIDDEN_MM = 4.0  # a nearer surface hides a vertex beyond this: a cell's own slope
DARKEST = 0.01  # linear: added before ratios are taken, so that noise of dark cells makes no colours
DETAIL_FLOOR = 0.01  # of a cell's mean: fine structure that noise and rounding make
DETAIL_BLUR_CELLS = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class HeadGuide:
    """Holds, for each vertex of a fitted head, its signed distance (mm) from the border of the face region, positive
    inside, its height (mm) above the chin along the head's upward axis, and whether it belongs to a cheek, a facial
    feature, or the underside of the jaw."""

    mesh: Mesh  # world frame
    into_face_mm: Float[np.ndarray, " v"]
    above_chin_mm: Float[np.ndarray, " v"]
    cheek: Float[np.ndarray, " v"]  # 1 on cheeks and nose, which no beard and no fringe reaches, else 0
    feature: Float[np.ndarray, " v"]  # 0 to 1: brows, eyes, lips and nostrils, whose colours are not those of skin
    underside: Float[np.ndarray, " v"]  # 0 to 1: below jaw, chin and nose, in shadow
    up: Vector  # unit, world
    chin: Vector
    middle: Vector


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Holds a coarse grid of cells over one view. Where the head covers a cell, the cell's position (``into_face_mm``,
    ``above_chin_mm``) is that of the fitted head's surface. Elsewhere the cell's position is that on the plane through
    the head's centre that faces the camera."""

    camera: Camera
    size_px: int
    colour: Float32[np.ndarray, "r c 3"]  # log red / green, log blue / green, log luminance; gains taken out
    detail: Float32[np.ndarray, "r c"]  # log of fine structure against the mean
    grey: Float32[np.ndarray, "r c"]  # sRGB, 0 to 1; its edges guide the smoothing of labels
    inside: Float32[np.ndarray, "r c"]  # share of the cell in the silhouette
    on_head: Bool[np.ndarray, "r c"]
    into_face_mm: Float32[np.ndarray, "r c"]
    above_chin_mm: Float32[np.ndarray, "r c"]
    cheek: Float32[np.ndarray, "r c"]
    feature: Float32[np.ndarray, "r c"]
    underside: Float32[np.ndarray, "r c"]
    outside_mm: Float32[np.ndarray, "r c"]  # from the head's outline, 0 within


def head_guide(mesh: Mesh, face_region: Bool[np.ndarray, " v"], landmarks: Mapping[str, Vector]) -> HeadGuide:
    """Computes the position of each vertex of a fitted head on the head. ``landmarks`` (world frame, mm) must contain
    the corners of eyes and mouth, glabella, subnasale, stomion and gnathion."""
    vertices, chin = mesh.vertices, landmarks["gnathion"]
    eyes = (landmarks["exocanthion_right"] + landmarks["exocanthion_left"]) / 2
    left = landmarks["exocanthion_left"] - landmarks["exocanthion_right"]
    forward = np.cross(left, eyes - chin)
    up = np.cross(forward, left)
    up /= np.linalg.norm(up)
    mixed = face_region[mesh.faces].any(axis=1) & ~face_region[mesh.faces].all(axis=1)
    border = vertices[np.unique(mesh.faces[mixed])]
    distance = nearest(PointTree.of(border), vertices)[0] if len(border) else np.full(len(vertices), 1e3)
    into_face, height = np.where(face_region, distance, -distance), (vertices - chin) @ up
    downward = np.clip(-(mesh.normals() @ up - DOWNWARD[0]) / (DOWNWARD[0] - DOWNWARD[1]), 0.0, 1.0)
    feature, underside = _features(vertices, landmarks, up), downward * np.clip(into_face / 20.0 + 2.0, 0.0, 1.0)
    across = np.abs((vertices - eyes) @ left) / float(left @ left)
    low, high = float((landmarks["subnasale"] - chin) @ up), float((eyes - chin) @ up)
    cheek = (into_face > CHEEK_INSIDE_MM) & (height > low + CHEEK_MARGIN_MM) & (height < high)
    cheek &= np.maximum(feature, underside) < 0.1
    cheek &= across < 0.5  # no farther out than the eyes: sideburns
    return HeadGuide(
        mesh=mesh,
        into_face_mm=into_face,
        above_chin_mm=height,
        cheek=cheek.astype(float),
        feature=feature,
        underside=underside,
        up=up,
        chin=chin,
        middle=vertices[(vertices - chin) @ up > 0].mean(axis=0),
    )


def _features(vertices: Float[np.ndarray, "v 3"], marks: Mapping[str, Vector], up: Vector) -> Float[np.ndarray, " v"]:
    found = np.zeros(len(vertices))
    spots = [(marks["subnasale"], 9.0)]
    for side in ("right", "left"):
        outer, inner = marks[f"exocanthion_{side}"], marks[f"endocanthion_{side}"]
        lift = abs(float((marks["glabella"] - inner) @ up))
        spots += [((outer + inner) / 2, 17.0)]
        spots += [(inner + t * (outer - inner) + lift * up, 11.0) for t in (0.0, 0.5, 1.0, 1.2)]
        for t in (0.0, 0.5):
            spots.append(((1 - t) * marks["stomion"] + t * marks[f"cheilion_{side}"], 10.0))
        spots.append((marks[f"cheilion_{side}"], 6.0))
    for centre, radius in spots:
        distance = np.linalg.norm(vertices - centre, axis=1)
        found = np.maximum(found, np.clip(1.5 - distance / radius, 0.0, 1.0))
    return found


def make_cells(
    images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
    masks: Mapping[str, Bool[np.ndarray, "h w"]],
    rig: Rig,
    head: HeadGuide,
    cell_mm: float,
) -> list[Cells]:
    """Computes the cells of every view that has a photograph, after balancing the colours of all cameras."""
    cameras = [camera for camera in rig if camera.name in images]
    sizes = [_cell_px(camera, head.middle, cell_mm) for camera in cameras]
    shots = [images[camera.name] for camera in cameras]

    def read_view(k: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        return _linear(shots[k], sizes[k]), _seen(cameras[k], sizes[k], head, _grid(shots[k], sizes[k]))

    light, seen = zip(*map_in_threads(read_view, len(cameras)), strict=True) if cameras else ((), ())
    gains = _gains(cameras, sizes, list(light), [depth for depth, _ in seen], head)

    def cells(k: int) -> Cells:
        mask = masks[cameras[k].name]
        return _cells(cameras[k], sizes[k], shots[k], mask, light[k] * gains[k], seen[k], head=head)

    return map_in_threads(cells, len(cameras))


def _cell_px(camera: Camera, at_world: Vector, cell_mm: float) -> int:
    depth = float(camera_depths(camera, at_world[None])[0])
    # A head that lies on the camera, or before it, has cells as large as the picture.
    largest = min(camera.intrinsics.width, camera.intrinsics.height)
    return int(np.clip(round(cell_mm * camera.intrinsics.fx / max(depth, 1e-3)), 1, largest))


def _linear(image: UInt8[np.ndarray, "h w 3"], size: int) -> Float32[np.ndarray, "r c 3"]:
    """Returns the mean linear colour of every complete cell."""
    table = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
    return _means(cv2.LUT(image, table), size)


def _grid(values: np.ndarray, size: int) -> tuple[int, int]:
    """Returns the number of rows and columns of complete cells."""
    return values.shape[0] // size, values.shape[1] // size


def _means(values: np.ndarray, size: int) -> np.ndarray:
    rows, columns = _grid(values, size)
    whole = values[: rows * size, : columns * size]
    return cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)


def _seen(
    camera: Camera, size: int, head: HeadGuide, shape: tuple[int, int]
) -> tuple[Float32[np.ndarray, "r c"], Float32[np.ndarray, "r c 5"]]:
    """Returns the head's depth (mm) at every cell's centre, inf beside the head, and the position values there."""
    pixels = (camera.project(head.mesh.vertices) - (size - 1) / 2) / size
    depths = camera_depths(camera, head.mesh.vertices)
    depth, face = rasterise(pixels, depths, head.mesh.faces, *shape)
    values = np.stack([head.into_face_mm, head.above_chin_mm, head.cheek, head.feature, head.underside], axis=1)
    return depth, interpolate(face, pixels, depths, head.mesh.faces, values.astype(np.float32))


def _gains(
    cameras: list[Camera],
    sizes: list[int],
    light: list[Float32[np.ndarray, "_ _ 3"]],
    depths: list[Float32[np.ndarray, "_ _"]],
    head: HeadGuide,
) -> Float32[np.ndarray, "k 3"]:
    """Returns the linear gain of every camera's colours, estimated from parts of the face that several cameras see."""
    rows = np.flatnonzero(head.into_face_mm > 0)
    rows = rows[:: max(1, len(rows) // BALANCE_VERTICES)]
    points, normals = head.mesh.vertices[rows], head.mesh.normals()[rows]
    weights = np.zeros((len(cameras), len(rows)), np.float32)
    colours = np.zeros((len(cameras), len(rows), 3), np.float32)
    for k, (camera, size, picture, depth) in enumerate(zip(cameras, sizes, light, depths, strict=True)):
        at = np.nan_to_num((camera.project(points) - (size - 1) / 2) / size, nan=-1.0)
        column, row = np.rint(at).astype(int).T
        framed = (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
        column, row = np.where(framed, column, 0), np.where(framed, row, 0)
        towards = camera.centre_world - points
        facing = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
        free = camera_depths(camera, points) < depth[row, column] + HIDDEN_MM
        weights[k] = np.where(framed & free & (facing > MIN_FACING), facing, 0.0)
        colours[k] = picture[row, column]
    return balance(weights, colours)[0].astype(np.float32)


def _cells(
    camera: Camera,
    size: int,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    light: Float32[np.ndarray, "r c 3"],
    seen: tuple[Float32[np.ndarray, "r c"], Float32[np.ndarray, "r c 5"]],
    *,
    head: HeadGuide,
) -> Cells:
    depth, values = seen
    on_head = np.isfinite(depth)
    red, green, blue = np.moveaxis(np.log(np.maximum(light, 0.0) + DARKEST), 2, 0)
    luminance = np.asarray(light @ np.array([0.2126, 0.7152, 0.0722], np.float32))
    colour = np.stack([red - green, blue - green, np.log(luminance + DARKEST)], axis=-1)
    rows, columns = depth.shape
    beside = (~on_head).astype(np.uint8)
    px_per_mm = camera.intrinsics.fx / float(camera_depths(camera, head.middle[None])[0])
    outside = cv2.distanceTransform(beside, cv2.DIST_L2, 3) * size / px_per_mm if on_head.any() else beside * 1e3
    height = np.where(on_head, values[..., 1], _height_beside(camera, size, (rows, columns), head))
    return Cells(
        camera=camera,
        size_px=size,
        colour=colour.astype(np.float32),
        detail=_detail(image, size),
        grey=_means(grey_of(image), size),
        inside=_means(mask.astype(np.float32), size),
        on_head=on_head,
        into_face_mm=np.where(on_head, values[..., 0], -outside).astype(np.float32),
        above_chin_mm=height.astype(np.float32),
        cheek=np.where(on_head, values[..., 2], 0.0).astype(np.float32),
        feature=np.where(on_head, values[..., 3], 0.0).astype(np.float32),
        underside=np.where(on_head, values[..., 4], 0.0).astype(np.float32),
        outside_mm=outside.astype(np.float32),
    )


def _height_beside(camera: Camera, size: int, shape: tuple[int, int], head: HeadGuide) -> Float[np.ndarray, "r c"]:
    """Returns the height (mm) above the chin at which each cell's ray meets the plane through the head's centre that
    faces the camera. This height is nearly affine in the image, so it is interpolated from a 3 x 3 grid of rays."""
    row, column = np.meshgrid(np.linspace(0, shape[0] - 1, 3), np.linspace(0, shape[1] - 1, 3), indexing="ij")
    pixels = np.stack([column.ravel(), row.ravel()], axis=1) * size + (size - 1) / 2
    rays = camera.rays_world(pixels)
    ahead = camera.camera_from_world.rotation[2]
    reach = float((head.middle - camera.centre_world) @ ahead)
    points = camera.centre_world + reach * rays / (rays @ ahead)[:, None]
    height = (points - head.chin) @ head.up
    plane = np.column_stack([np.ones(9), column.ravel(), row.ravel()])
    a, b, c = np.linalg.lstsq(plane, height, rcond=None)[0]
    return a + b * np.arange(shape[1])[None, :] + c * np.arange(shape[0])[:, None]


def grey_of(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Returns the photograph in grey (sRGB values scaled to 0 to 1)."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).astype(np.float32) / np.float32(255.0)


def _detail(image: UInt8[np.ndarray, "h w 3"], size: int) -> Float32[np.ndarray, "r c"]:
    """Returns, for each cell, the logarithm of the standard deviation of fine structure within and around the cell,
    divided by the mean grey value."""
    grey = 255.0 * grey_of(image)
    fine = cv2.GaussianBlur(grey, (0, 0), 0.8) - cv2.GaussianBlur(grey, (0, 0), 0.6 * size)
    square, mean = _means(fine * fine, size), _means(grey, size)
    square, mean = (cv2.GaussianBlur(each, (0, 0), DETAIL_BLUR_CELLS) for each in (square, mean))
    return np.log(np.sqrt(square) / (mean + 8.0) + DETAIL_FLOOR).astype(np.float32)
