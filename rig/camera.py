"""Models a calibrated camera: a pose and a pinhole projection with Brown-Conrady distortion.

A point (X, Y, Z) in the camera frame has ``x = X / Z``, distorted to ``x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) +
tangential``, and the pixel ``u = fx x_d + cx``. Coefficients have OpenCV's order k1 k2 p1 p2 k3. Pixel (0, 0) is the
centre of the top-left pixel."""

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from rig.geometry import RigidTransform, rotation_from_vector
from rig.recorded_lens import RecordedLens

Pixels = Float[np.ndarray, "n 2"]
Points = Float[np.ndarray, "n 3"]


@lru_cache(maxsize=1024)  # needed at every projection; the roots of a cubic cost more than projecting a point
def _turning_radius(k1: float, k2: float, k3: float) -> float:
    """Returns the radius at which the radial model ``r (1 + k1 r^2 + k2 r^4 + k3 r^6)`` stops growing, or infinity."""
    cubic = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    squares = cubic.real[(np.abs(cubic.imag) < 1e-12) & (cubic.real > 0)]
    return float(np.sqrt(squares.min())) if len(squares) else np.inf


@dataclass(frozen=True, slots=True)
class Distortion:
    """Holds Brown-Conrady coefficients, as defined at https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def is_zero(self) -> bool:
        """Returns whether all coefficients are 0."""
        return not (self.k1 or self.k2 or self.p1 or self.p2 or self.k3)

    def opencv(self) -> Float[np.ndarray, " 5"]:
        """Returns k1 k2 p1 p2 k3, in OpenCV's order."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def max_valid_radius(self) -> float:
        """Returns the radius, in units of ``X / Z``, up to which the distortion is one-to-one. Beyond the radius, the
        model maps points back inwards."""
        return _turning_radius(self.k1, self.k2, self.k3)

    def apply(self, normalised: Pixels) -> Pixels:
        """Distorts normalised coordinates ``X / Z, Y / Z``."""
        return np.ascontiguousarray(_distorted(normalised.T, self.opencv()).T)

    def remove(self, distorted: Pixels) -> Pixels:
        """Removes the distortion by Newton's method. Returns NaN where no point inside the valid radius is a
        solution."""
        if self.is_zero:
            return distorted.copy()
        limit = self.max_valid_radius()
        guess, wanted, lens = distorted.T, distorted.T, self.opencv()
        miss = _distorted(guess, lens) - wanted
        for _ in range(20):
            if not miss.size or np.abs(miss).max() < 1e-13:
                break
            xx, cross, yy = _distortion_slopes(guess, lens)
            step = np.array([yy * miss[0] - cross * miss[1], xx * miss[1] - cross * miss[0]]) / (xx * yy - cross**2)
            guess = guess - step
            radius = np.maximum(np.hypot(guess[0], guess[1]), 1e-9)
            guess *= np.minimum(0.999 * limit / radius, 1.0)  # step back inside, where the map is one to one
            miss = _distorted(guess, lens) - wanted
        return np.ascontiguousarray(np.where(np.abs(miss).max(axis=0) > 1e-9, np.nan, guess).T)


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Holds the image size, focal lengths and principal point of one camera (px), and its distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = field(default_factory=Distortion)

    def values(self) -> Float[np.ndarray, " 9"]:
        """Returns fx fy cx cy (px) k1 k2 p1 p2 k3."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion.opencv()])

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Returns the camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, factor: float) -> "Intrinsics":
        """Returns the intrinsics for an image scaled by ``factor``. Pixel u becomes ``(u + 1/2) factor - 1/2``."""
        return self.at_size(round(self.width * factor), round(self.height * factor))

    def at_size(self, width: int, height: int) -> "Intrinsics":
        """Returns the intrinsics for the same image resampled to another size (px)."""
        sx, sy = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, cx, cy, self.distortion)


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Describes a calibrated camera.

    ``covariance`` (6 x 6) is that of a left perturbation of ``camera_from_world``: rotation (rad), then translation
    (mm). If the reader undistorts the picture files, ``recorded`` is the lens of the files and ``intrinsics`` a
    pinhole. ``serial`` is the serial number of the camera body, from the picture files."""

    name: str
    intrinsics: Intrinsics
    camera_from_world: RigidTransform
    covariance: Float[np.ndarray, "6 6"] | None = None
    recorded: RecordedLens | None = None
    serial: str | None = None

    @property
    def centre_world(self) -> Float[np.ndarray, " 3"]:
        """Returns the centre of projection, in the world frame (mm)."""
        return self.camera_from_world.inverse().translation

    @property
    def axis_world(self) -> Float[np.ndarray, " 3"]:
        """Returns the unit vector along the optical axis, in the world frame."""
        return self.camera_from_world.rotation[2]

    def moved(self, step: Float[np.ndarray, " 6"]) -> "Camera":
        """Returns the camera after a left perturbation of its pose: a rotation vector (rad) and a translation (mm) in
        the camera frame."""
        motion = RigidTransform(rotation_from_vector(step[:3]), step[3:])
        return replace(self, camera_from_world=motion @ self.camera_from_world)

    def project(self, points_world: Points) -> Pixels:
        """Projects world points (mm) to pixels. Returns NaN behind the camera and outside the valid radius."""
        return self._image(self.camera_from_world.apply(points_world))

    def project_with_jacobian(self, points_world: Points) -> tuple[Pixels, Float[np.ndarray, "n 2 3"]]:
        """Returns the pixels of world points (mm), and their derivatives by the points (px / mm)."""
        points = self.camera_from_world.apply(points_world)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_point = lens_slopes(points, self.intrinsics.values())
        return self._image(points), by_point @ self.camera_from_world.rotation

    def rays_world(self, pixels: Pixels) -> Points:
        """Returns unit directions, in the world frame, of the rays through ``pixels``."""
        normalised = self.undistort(pixels)
        rays = np.concatenate([normalised, np.ones((len(pixels), 1))], axis=1) @ self.camera_from_world.rotation
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def undistort(self, pixels: Pixels) -> Pixels:
        """Returns the normalised coordinates ``X / Z, Y / Z`` of pixels, with the distortion removed."""
        k = self.intrinsics
        return k.distortion.remove((pixels - (k.cx, k.cy)) / (k.fx, k.fy))

    def _image(self, points: Points) -> Pixels:
        """Projects points in the camera's frame (mm) to pixels."""
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = lens_image(points, self.intrinsics.values())
            radius = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
            bad = (points[:, 2] <= 0) | (radius > self.intrinsics.distortion.max_valid_radius())
        pixels[bad] = np.nan
        return pixels


def lens_image(points: Points, lens: Float[np.ndarray, "*n 9"]) -> Pixels:
    """Projects points in a camera's frame (mm) to pixels.

    ``lens`` is fx fy cx cy (px) k1 k2 p1 p2 k3, for all points or for each point. The points must lie in front of the
    camera and inside the distortion's valid radius."""
    distorted = np.ascontiguousarray(_distorted(points[:, :2].T / points[:, 2], lens[..., 4:]).T)
    return distorted * lens[..., :2] + lens[..., 2:4]


def lens_slopes(points: Points, lens: Float[np.ndarray, "*n 9"]) -> Float[np.ndarray, "n 2 3"]:
    """Returns the derivatives of each pixel of ``lens_image`` by its point (px / mm)."""
    normalised, z = points[:, :2] / points[:, 2:], points[:, 2, None]
    slopes = np.ascontiguousarray(_distortion_slopes(normalised.T, lens[..., 4:])[[0, 1, 1, 2]].T).reshape(-1, 2, 2)
    slopes = lens[..., :2, None] * slopes
    by_depth = (slopes * (-normalised / z)[:, None]).sum(axis=2)
    return np.concatenate([slopes * (1.0 / z)[:, None], by_depth[:, :, None]], axis=2)


def lens_jacobians(
    points: Points, lens: Float[np.ndarray, "*n 9"]
) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 9"]]:
    """Returns the derivatives of each pixel of ``lens_image`` by its point (px / mm) and by the nine lens values."""
    normalised, focal = points[:, :2] / points[:, 2:], lens[..., :2, None]
    x, y = normalised.T
    r2 = x * x + y * y
    by_lens = np.zeros((len(points), 2, 9))
    by_lens[:, [0, 1], [0, 1]] = _distorted(normalised.T, lens[..., 4:]).T
    by_lens[:, [0, 1], [2, 3]] = 1.0
    by_lens[:, 0, 4:] = np.stack([x * r2, x * r2**2, 2.0 * x * y, r2 + 2.0 * x * x, x * r2**3], axis=1)
    by_lens[:, 1, 4:] = np.stack([y * r2, y * r2**2, r2 + 2.0 * y * y, 2.0 * x * y, y * r2**3], axis=1)
    by_lens[:, :, 4:] *= focal
    return lens_slopes(points, lens), by_lens


def _distorted(normalised: Float[np.ndarray, "2 n"], lens: Float[np.ndarray, "*n 5"]) -> Float[np.ndarray, "2 n"]:
    """Distorts normalised coordinates ``X / Z, Y / Z`` by the equation of the module's docstring."""
    (x, y), (k1, k2, p1, p2, k3) = normalised, lens.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.array([across, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])


def _distortion_slopes(
    normalised: Float[np.ndarray, "2 n"], lens: Float[np.ndarray, "*n 5"]
) -> Float[np.ndarray, "3 n"]:
    """Returns the entries xx, xy and yy of the symmetric matrix of derivatives of ``_distorted`` by the coordinates."""
    (x, y), (k1, k2, p1, p2, k3) = normalised, lens.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d(radial) / d(r^2) * 2
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return np.array([xx, cross, yy])
