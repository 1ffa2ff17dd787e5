"""Estimates each camera's lens from that camera's views of the board. Bundle adjustment starts from these lenses.

Cameras are treated alone, so shots need not be synchronised. IPPE computes the board's poses for each of several focal
lengths (T. Collins, A. Bartoli, "Infinitesimal Plane-Based Pose Estimation", IJCV 2014). A bundle adjustment of a
single camera (``bundle.py``) completes the estimate. A lens's covariance shows if the views suffice."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from calibration.adjustment.bundle import CAUCHY, BundleSolution, adjust
from calibration.adjustment.lens_prior import weak_prior
from calibration.adjustment.state import INTRINSICS, BundleState, intrinsics_of, observe_views, orthonormal, residuals
from calibration.board.board import Board
from calibration.board.corners import Found
from calibration.board.detection import Detections, View
from rig.camera import Intrinsics
from rig.geometry import RigidTransform
from rig.messages.message import Message, compose

VIEWS_LEAST = 3  # two views of a plane determine fx, fy, cx, cy in theory; a third is the first check
FOCAL_SHARE_MOST = 0.02  # relative standard deviation from which on a focal length counts as badly determined
SCAN = np.geomspace(0.5, 4.5, 12)  # candidates of focal length / longer side of the image
CORNER_SIGMA_LEAST = 0.02  # px; no detector is better, and a perfect fit must not get an infinite weight


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Holds one camera's lens, estimated from that camera alone. ``covariance`` is the covariance of fx fy cx cy (px)
    k1 k2 p1 p2 k3; ``poses`` holds the board's pose in each shot."""

    camera: str
    intrinsics: Intrinsics
    covariance: Float[np.ndarray, "9 9"]
    rms_px: float
    noise_px: float  # robust standard deviation of one coordinate
    views: int
    corners: int
    poses: dict[str, RigidTransform]  # camera_from_board by shot

    @property
    def sigma(self) -> Float[np.ndarray, " 9"]:
        """Returns the standard deviations of fx fy cx cy (px) k1 k2 p1 p2 k3."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def weakness(self) -> Message | None:
        """Returns a message that explains why the views do not determine the lens well; None if they do."""
        if self.views < VIEWS_LEAST:
            return compose("lens-views-too-few", camera=self.camera, views=self.views, needed=VIEWS_LEAST)
        share = self.sigma[0] / self.intrinsics.fx
        if share > FOCAL_SHARE_MOST:
            return compose("focal-uncertain", camera=self.camera, views=self.views, percent=100 * share)
        return None


def estimate_lenses(detections: Detections) -> dict[str, Lens]:
    """Estimates the lens of every camera that sees the board, from that camera's views alone."""
    views_of = {camera: [v for v in detections.views if v.camera == camera] for camera in detections.sizes}
    return {
        camera: estimate_lens(views, detections.sizes[camera], detections.board)
        for camera, views in views_of.items()
        if views
    }


def estimate_lens(views: Sequence[View], size: tuple[int, int], board: Board) -> Lens:
    """Estimates the lens of one camera, and the board's poses, from its views. ``size`` is width and height, px."""
    shots = [view.shot for view in views]
    observed = observe_views(views, [views[0].camera], shots, board)
    state = _start(views, size, board)
    prior, sigma = weak_prior([size]), np.array([1.0])
    solution = adjust(state, observed, prior, sigma, loss=CAUCHY)
    # Whole views that no pose explains (a misread grid) must not bend the lens: Cauchy's rho downweights them, and its
    # scale becomes the camera's own noise here.
    for _ in range(2):
        sigma = np.array([noise_of(residuals(solution.state, observed))])
        solution = adjust(solution.state, observed, prior, sigma, loss=CAUCHY)
    state = orthonormal(solution.state)
    return _lens(views, size, solution, state, float(sigma[0]), residuals(state, observed))


def _lens(
    views: Sequence[View],
    size: tuple[int, int],
    solution: BundleSolution,
    state: BundleState,
    noise: float,
    misses: np.ndarray,
) -> Lens:
    squares = (misses**2).sum(axis=1)
    good = squares < (6 * noise) ** 2
    covariance = solution.covariance()[: len(INTRINSICS), : len(INTRINSICS)]
    poses = {
        view.shot: RigidTransform(rotation, translation)
        for view, rotation, translation in zip(views, state.board_rotations, state.board_translations, strict=True)
    }
    rms = float(np.sqrt(squares[good].mean()))
    intrinsics = intrinsics_of(state.intrinsics[0], size)
    return Lens(views[0].camera, intrinsics, covariance, rms, noise, len(views), len(misses), poses)


def noise_of(misses: Float[np.ndarray, "n 2"]) -> float:
    """Returns the robust standard deviation (px) of one coordinate of 2D residuals. The robust deviation is the
    residuals' median length divided by 1.1774, the median length for unit variance. The deviation is at least
    ``CORNER_SIGMA_LEAST``, and 1 if there are no residuals."""
    if not len(misses):
        return 1.0
    return max(float(np.median(np.linalg.norm(misses, axis=1))) / 1.1774, CORNER_SIGMA_LEAST)


def _start(views: Sequence[View], size: tuple[int, int], board: Board) -> BundleState:
    """Returns the initial state: the best-fitting of several focal lengths, a central principal point, no distortion,
    and board poses by IPPE."""
    width, height = size
    best: tuple[float, Intrinsics, list[RigidTransform]] | None = None
    for share in SCAN:
        focal = share * max(size)
        intrinsics = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        fits = [board_poses_of(view.found, intrinsics, board)[0] for view in views]
        # Mean of square roots, so that one bad view does not decide the focal length.
        score = float(np.mean([np.sqrt(rms) for _, rms in fits]))
        if best is None or score < best[0]:
            best = (score, intrinsics, [pose for pose, _ in fits])
    assert best is not None
    _, intrinsics, poses = best
    return BundleState(
        intrinsics.values()[None],
        np.eye(3)[None],
        np.zeros((1, 3)),
        np.stack([pose.rotation for pose in poses]),
        np.stack([pose.translation for pose in poses]),
        np.zeros(1),
        np.zeros((len(poses), 6)),
    )


def board_poses_of(detection: Found, intrinsics: Intrinsics, board: Board) -> list[tuple[RigidTransform, float]]:
    """Returns the possible poses camera_from_board of one view with their RMS errors (px), best first. The image of a
    plane allows up to two poses."""
    points = board.corners()[detection.ids]
    count, turns, shifts, errors = cv2.solvePnPGeneric(
        points, detection.corners, intrinsics.matrix(), intrinsics.distortion.opencv(), flags=cv2.SOLVEPNP_IPPE
    )
    fits = []
    for turn, shift, error in zip(turns[:count], shifts[:count], np.asarray(errors).ravel(), strict=False):
        pose = RigidTransform(cv2.Rodrigues(np.asarray(turn))[0], np.asarray(shift, dtype=float).ravel())
        if np.isfinite(pose.rotation).all() and np.isfinite(pose.translation).all() and pose.translation[2] > 0:
            fits.append((pose, float(error)))
    return sorted(fits, key=lambda fit: fit[1]) or [(RigidTransform(np.eye(3), np.array([0.0, 0.0, 1e3])), 1e3)]
