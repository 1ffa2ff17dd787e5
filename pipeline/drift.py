"""Has a camera moved since the calibration? Asked of every capture, before the fit, of the silhouettes alone.

The planes through two camera centres that touch the subject touch both silhouettes: epipolar tangency, at frontier
points (Ramanathan, Steinbach and Girod 2000, the paper's reference for calibration from silhouettes). Hair and
shoulders are as good as skin, since the subject is rigid within a shot. Eleven cameras give about fifty such equations,
good to 0.2 px. A camera that was turned by a small angle shifts its whole image; its equations then agree on one shift,
and only its own do.

Enters: silhouettes and the rig. Leaves: the cameras that have moved, how far, how sure.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.silhouette import Silhouette
from rig.camera import Camera
from rig.layout import Rig

BORDER_PX = 4.0  # a tangent this near the image border may belong to what the border has cut off
NOISE_FLOOR_PX = 0.4  # of one tangency: two contours of 0.25 px, never less however well they agree by chance
ROBUST_SIGMAS = 3.0
EQUATIONS_LEAST = 5  # of a camera: two unknowns, and enough left over to judge them
SIGMAS_LEAST, SHIFT_LEAST_PX = 6.0, 1.5  # docs/results.md: false alarms against misses
GAIN_LEAST = 0.4  # share of the camera's own robust misfit that its shift must explain, and of all but one of them


@dataclass(frozen=True, slots=True, eq=False)
class Tangency:
    """One tangent plane of two cameras: in each camera the pixel where it touches, the unit normal of the epipolar line
    (px), the plane's change of angle per pixel (rad), and by how many pixels its silhouette reaches beyond the plane
    that touches the other's."""

    cameras: tuple[str, str]
    pixels: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]
    steepness: tuple[float, float]
    normals: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]
    excess_px: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """A camera that has moved: its image's shift (px) and standard deviation, the turn that explains it, and how many
    standard deviations that is."""

    camera: str
    shift_px: Float[np.ndarray, " 2"]
    deviation_px: float
    turn_deg: float
    sigmas: float

    def __str__(self) -> str:
        return (
            f"{self.camera} has moved by {np.linalg.norm(self.shift_px):.1f} px in its image "
            f"(a turn of {self.turn_deg:.2f} degrees, {self.sigmas:.0f} standard deviations) and is left out: "
            "fasten it and calibrate again"
        )


def find_drift(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Drift, ...]:
    """Cameras that no longer stand where their calibration says, the farthest moved first.

    One after the other: what the worst camera does to its neighbours' equations goes with it.
    """
    usable = rig.subset(name for name in rig.names if name in silhouettes and silhouettes[name].quality.usable)
    tangencies = find_tangencies(silhouettes, usable)
    found: list[Drift] = []
    names = list(usable.names)
    while len(names) > 3 and len(found) < len(usable) // 4 + 1:
        among = [t for t in tangencies if set(t.cameras) <= set(names)]
        judged = [drift for name in names if (drift := _judge(name, among, usable[name])) is not None]
        if not judged:
            break
        worst = max(judged, key=lambda drift: drift.sigmas)
        found.append(worst)
        names.remove(worst.camera)
    return tuple(sorted(found, key=lambda drift: -float(np.linalg.norm(drift.shift_px))))


def find_tangencies(silhouettes: Mapping[str, Silhouette], rig: Rig) -> list[Tangency]:
    """Every pair's outer tangent planes that both images hold whole."""
    outlines = {camera.name: _Outline.of(camera, silhouettes[camera.name]) for camera in rig}
    found = []
    for one, two in combinations(rig, 2):
        found += _pair(outlines[one.name], outlines[two.name], one, two)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Outline:
    """The convex hull of a mask: outer tangents touch nothing else."""

    pixels: Float[np.ndarray, "n 2"]
    rays: Float[np.ndarray, "n 3"]
    size: tuple[int, int]

    @classmethod
    def of(cls, camera: Camera, silhouette: Silhouette) -> "_Outline":
        contours, _ = cv2.findContours(silhouette.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        hull = cv2.convexHull(np.concatenate(contours)).reshape(-1, 2).astype(float)
        hull = on_contour(hull, silhouette.distance)
        return cls(hull, camera.rays_world(hull), (camera.intrinsics.width, camera.intrinsics.height))

    def cut(self, i: int) -> bool:
        x, y = self.pixels[i]
        return min(x, y, self.size[0] - 1 - x, self.size[1] - 1 - y) < BORDER_PX


def on_contour(pixels: Float[np.ndarray, "n 2"], distance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """Outermost pixel centres moved along the gradient of the signed distance onto the contour itself."""
    height, width = distance.shape
    x, y = pixels.astype(int).T
    left, right = np.maximum(x - 1, 0), np.minimum(x + 1, width - 1)
    up, down = np.maximum(y - 1, 0), np.minimum(y + 1, height - 1)
    slope = 0.5 * np.stack([distance[y, right] - distance[y, left], distance[down, x] - distance[up, x]], axis=1)
    norm = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 0.5)
    return pixels - np.clip(distance[y, x], -1.5, 1.5)[:, None] * slope / norm**2


def _pair(first: _Outline, second: _Outline, one: Camera, two: Camera) -> list[Tangency]:
    base = two.centre_world - one.centre_world
    axis = base / np.linalg.norm(base)
    towards = first.rays.mean(axis=0) + second.rays.mean(axis=0)
    u = towards - axis * (towards @ axis)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angles = [np.arctan2(outline.rays @ v, outline.rays @ u) for outline in (first, second)]
    if max(np.ptp(angle) for angle in angles) > 2.0:  # the epipole lies in or near the silhouette: no outer tangent
        return []
    found = []
    for pick in (np.argmax, np.argmin):
        i, j = int(pick(angles[0])), int(pick(angles[1]))
        if first.cut(i) or second.cut(j):
            continue
        difference = float(angles[0][i] - angles[1][j])
        slopes = [_angle_slope(one, first.pixels[i], u, v), _angle_slope(two, second.pixels[j], u, v)]
        steep = [float(np.linalg.norm(slope)) for slope in slopes]
        if min(steep) < 1e-9:
            continue
        normals = (slopes[0] / steep[0], slopes[1] / steep[1])
        found.append(
            Tangency(
                (one.name, two.name),
                (first.pixels[i], second.pixels[j]),
                (steep[0], steep[1]),
                normals,
                (difference / steep[0], -difference / steep[1]),
            )
        )
    return found


def _angle_slope(
    camera: Camera, pixel: Float[np.ndarray, " 2"], u: np.ndarray, v: np.ndarray
) -> Float[np.ndarray, " 2"]:
    """Change of a ray's angle in the pencil of epipolar planes per pixel."""
    rays = camera.rays_world(pixel + np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    angle = np.arctan2(rays @ v, rays @ u)
    return np.array([angle[0] - angle[1], angle[2] - angle[3]]) / 2.0


def _judge(name: str, tangencies: list[Tangency], camera: Camera) -> Drift | None:
    """The shift that the camera's own equations agree on, if there is one worth an alarm."""
    rows, excess = _equations(name, tangencies)
    if len(rows) < EQUATIONS_LEAST:
        return None
    others = [t.excess_px[0] for t in tangencies if name not in t.cameras]
    noise = max(NOISE_FLOOR_PX, 1.4826 * float(np.median(np.abs(others)))) if others else NOISE_FLOOR_PX
    shift, information = _robust_shift(rows, excess, noise)
    before, after = _misfits(excess, noise), _misfits(excess - rows @ shift, noise)
    deviation = float(np.sqrt(np.trace(np.linalg.inv(information + 1e-9 * np.eye(2)))))
    size = float(np.linalg.norm(shift))
    sigmas = float(np.sqrt(shift @ information @ shift))
    if sigmas < SIGMAS_LEAST or size < SHIFT_LEAST_PX or not _explains(before, after):
        return None
    turn = np.degrees(np.arctan(size / camera.intrinsics.fx))
    return Drift(name, shift, deviation, float(turn), sigmas)


def _equations(name: str, tangencies: list[Tangency]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    rows, excess = [], []
    for tangency in tangencies:
        for side in range(2):
            if tangency.cameras[side] == name:
                rows.append(tangency.normals[side])
                excess.append(tangency.excess_px[side])
    return np.array(rows).reshape(-1, 2), np.array(excess)


def _robust_shift(rows: np.ndarray, excess: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """The shift of least robust misfit: the best of those that pairs of equations propose, then reweighted."""
    scale = ROBUST_SIGMAS * noise
    proposals = [np.zeros(2)]
    for i, j in combinations(range(len(rows)), 2):
        pair = rows[[i, j]]
        if abs(np.linalg.det(pair)) > 0.3:
            proposals.append(np.linalg.solve(pair, excess[[i, j]]))
    misses = excess[None, :] - np.array(proposals) @ rows.T
    shift = proposals[int(np.argmin((misses**2 / (misses**2 + scale**2)).sum(axis=1)))]
    information = np.zeros((2, 2))
    for _ in range(10):
        miss = excess - rows @ shift
        weight = 1.0 / (1.0 + (miss / scale) ** 2) ** 2 / noise**2
        information = (rows * weight[:, None]).T @ rows
        shift = np.linalg.solve(information + 1e-6 * np.eye(2), (rows * weight[:, None]).T @ excess)
    return shift, information


def _explains(before: Float[np.ndarray, " n"], after: Float[np.ndarray, " n"]) -> bool:
    """Whether the shift takes enough of the misfits away, and not of a single one alone: a bad stretch of one outline
    is met by one tangent plane, a moved camera by all of its own."""
    others = np.arange(len(before)) != np.argmax(before - after)
    return all(after[k].sum() <= (1.0 - GAIN_LEAST) * before[k].sum() for k in (slice(None), others))


def _misfits(miss: Float[np.ndarray, " n"], noise: float) -> Float[np.ndarray, " n"]:
    """Robust misfit of each equation, 0 to 1."""
    scale = ROBUST_SIGMAS * noise
    return miss**2 / (miss**2 + scale**2)
