"""Models the fine texture of a person's skin in a sequence, at sample points of the surface and for each camera.

The texture of a picture is the logarithm of its grey values minus their local mean, so camera gain and shading do not
change it. The reference of a sample in a camera is its mean texture over the frames from which the person was
estimated; a camera that never saw the sample uses the mean over all cameras. Each frame is compared with the reference
and never with the previous frame, so errors do not accumulate."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.applications.moments.footage import Pictures
from pipeline.applications.moments.sequence_person import Motion, SequencePerson
from pipeline.compute.threads import map_in_threads
from pipeline.geometry.projection import camera_depths, project_points
from pipeline.geometry.projection_kernels import rasterise
from pipeline.head_model.expressions import BLINKS, plain_name
from pipeline.imaging.grey import LUMINANCE
from pipeline.photometric_fit.patches import spread_samples
from rig.camera import Camera
from rig.mesh import vertex_normals
from rig.rig import Rig

SAMPLE_MM = 2.5  # distance of samples
REDUCED = (2, 1)  # of the pictures, from coarse to fine
BLUR_PX = 1.0  # of a reduced picture
SHADING_PX, SHADING_SIZE = 5.0, 4  # the local mean's window, and by how much smaller its picture is
DARK = 12.0  # grey levels added before the logarithm: noise of dark pixels is not amplified
LID_MM = 1.5  # what a blink moves by more is a lid
MIN_COSINE = 0.3  # of a sample's normal to the camera
HIDDEN_MM = 6.0  # a surface nearer by more hides a sample: the depth is drawn at half the size
EDGE_PX = 5  # nothing is read nearer to the head's outline, half-size pixels


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Holds s sample points on a person's face: the vertices of their triangles, their barycentric coordinates, their
    neutral positions and their displacement by each expression (mm at weight 1)."""

    corners: Int[np.ndarray, "s 3"]
    shares: Float[np.ndarray, "s 3"]
    neutral: Float[np.ndarray, "s 3"]
    shapes: Float32[np.ndarray, "s 3 e"]

    def points(self, weights: Float[np.ndarray, " e"]) -> Float[np.ndarray, "s 3"]:
        """Returns the sample points for given expression weights, head frame, mm."""
        return self.neutral + self.shapes @ weights.astype(np.float32)


def spread(person: SequencePerson) -> Samples:
    """Returns sample points spread over the person's face without the lids, which may show the eyeball, not skin."""
    level, lids = person.model.levels["full"], lid_motion_mm(person) > LID_MM
    skin = level.face_region & ~lids
    corners, shares = spread_samples(person.neutral, level.faces[skin[level.faces].all(axis=1)], SAMPLE_MM)
    shapes = np.einsum("sk,eskc->sce", shares.astype(np.float32), person.shapes[:, corners], optimize=True)
    neutral = np.einsum("sk,skc->sc", shares, person.neutral[corners])
    return Samples(corners, shares, neutral, np.ascontiguousarray(shapes))


def lid_motion_mm(person: SequencePerson) -> Float[np.ndarray, " v"]:
    """Returns the distance (mm) that each vertex moves in a blink."""
    blinks = [k for k, name in enumerate(person.names) if plain_name(name) in BLINKS]
    return np.linalg.norm(person.shapes[blinks], axis=2).max(axis=0, initial=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """Holds the fine texture of a picture and its derivatives by x and y (per px), reduced by a factor ``reduced``."""

    image: Float32[np.ndarray, "h w 3"]
    reduced: int

    def read(self, pixels: Float[np.ndarray, "n 2"]) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
        """Returns texture and derivatives at pixels of the full-size picture, and a mask of the pixels inside it."""
        height, width = self.image.shape[:2]
        scaled = (pixels + 0.5) / self.reduced - 0.5
        inside = np.all((scaled >= 0.0) & (scaled < (width - 1.001, height - 1.001)), axis=1)  # False for NaN
        at = np.where(inside[:, None], scaled, 0.0)
        first = np.floor(at)
        column, row = first.astype(np.int64).T
        x, y = (at - first).astype(np.float32).T[:, :, None]
        flat, start = self.image.reshape(-1, 3), row * width + column
        top = flat[start] * (1.0 - x) + flat[start + 1] * x
        bottom = flat[start + width] * (1.0 - x) + flat[start + width + 1] * x
        return top * (1.0 - y) + bottom * y, inside


def texture_of(grey: Float32[np.ndarray, "h w"], reduced: int) -> Texture:
    """Returns the fine texture of a grey picture after reduction by an integer factor."""
    height, width = grey.shape
    if reduced > 1:
        grey = cv2.resize(grey, (width // reduced, height // reduced), interpolation=cv2.INTER_AREA)
    levels = np.log(cv2.GaussianBlur(grey, (0, 0), BLUR_PX) + DARK)
    size = levels.shape[1] // SHADING_SIZE, levels.shape[0] // SHADING_SIZE
    small = cv2.GaussianBlur(cv2.resize(levels, size, interpolation=cv2.INTER_AREA), (0, 0), SHADING_PX / SHADING_SIZE)
    fine = levels - cv2.resize(small, levels.shape[::-1], interpolation=cv2.INTER_LINEAR)
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32) / np.float32(reduced)
    slopes = cv2.filter2D(fine, -1, kernel), cv2.filter2D(fine, -1, kernel.T)
    return Texture(cv2.merge([fine, *slopes]), reduced)


def textures(pictures: Pictures, rig: Rig, reduced: int) -> list[Texture | None]:
    """Returns the fine texture of each camera's picture in one frame; None for a camera without a picture."""

    def one(k: int) -> Texture | None:
        image = pictures.get(rig.names[k])
        return None if image is None else texture_of(cv2.transform(image, LUMINANCE[None]).astype(np.float32), reduced)

    return map_in_threads(one, len(rig))


def visible(person: SequencePerson, samples: Samples, motion: Motion) -> list[Int[np.ndarray, " n"]]:
    """Returns the indices of the sample points that each camera sees, without those near the outline of the head."""
    pose, level = motion.world_from_head, person.model.levels["p95"]
    head = person.head(motion.weights)
    coarse = pose.apply(head[level.rows])
    points = pose.apply(samples.points(motion.weights))
    full = vertex_normals(head, person.model.levels["full"].faces) @ pose.rotation.T
    normals = np.einsum("sk,skc->sc", samples.shares, full[samples.corners])
    half = person.rig.scaled(0.5)

    def one(k: int) -> Int[np.ndarray, " n"]:
        camera = half.cameras[k]
        size = camera.intrinsics.height, camera.intrinsics.width
        depth, _ = rasterise(project_points(camera, coarse), camera_depths(camera, coarse), level.faces, *size)
        inside = cv2.erode(np.isfinite(depth).astype(np.uint8), np.ones((2 * EDGE_PX + 1,) * 2, np.uint8))
        return np.flatnonzero(_seen(camera, points, normals, depth, inside))

    return map_in_threads(one, len(half))


def _seen(
    camera: Camera,
    points: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    depth: Float32[np.ndarray, "h w"],
    inside: np.ndarray,
) -> Bool[np.ndarray, " s"]:
    towards = camera.centre_world - points
    facing = (normals * towards).sum(axis=1) > MIN_COSINE * np.linalg.norm(towards, axis=1)
    at = np.rint(np.nan_to_num(project_points(camera, points), nan=-9.0)).astype(int)
    facing &= ((at >= 0) & (at < depth.shape[::-1])).all(axis=1)
    column, row = np.where(facing[:, None], at, 0).T
    return facing & (inside[row, column] > 0) & (camera_depths(camera, points) < depth[row, column] + HIDDEN_MM)


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """Holds the reference texture of every sample point in every camera (NaN if no camera ever saw the point), and the
    standard deviation of a frame's texture from the reference."""

    reference: Float32[np.ndarray, "k s"]
    deviation: float


def observe(
    person: SequencePerson, samples: Samples, shown: Iterable[tuple[Pictures, Motion]], reduced: int
) -> Appearance:
    """Computes the reference texture of a person from frames with known motions."""
    shape = (len(person.rig), len(samples.neutral))
    total, count, squares = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for pictures, motion in shown:
        points, seen = motion.world_from_head.apply(samples.points(motion.weights)), visible(person, samples, motion)
        for k, image in enumerate(textures(pictures, person.rig, reduced)):
            if image is None:
                continue
            values, inside = image.read(project_points(person.rig.cameras[k], points[seen[k]]))
            rows = seen[k][inside]
            total[k, rows] += values[inside, 0]
            squares[k, rows] += values[inside, 0] ** 2
            count[k, rows] += 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, pooled = total / count, total.sum(axis=0) / count.sum(axis=0)
        several = count > 1.0
        spread_of = squares[several] / count[several] - mean[several] ** 2
        spread_of *= count[several] / (count[several] - 1.0)
    deviation = float(np.sqrt(np.median(spread_of) / 0.55)) if len(spread_of) else 0.05
    return Appearance(np.where(count > 0.0, mean, pooled[None]).astype(np.float32), max(deviation, 1e-3))


Levels = Mapping[int, Appearance]  # by how much the pictures are reduced
