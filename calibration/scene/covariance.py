"""Computes the covariance of the cameras by inverting the bundle adjustment's reduced camera system.

The normal equations have a block U of the cameras, V of the points, and W between both. Eliminating the points leaves
``S = U - W V^-1 W^T`` (Triggs et al., "Bundle Adjustment: A Modern Synthesis", 1999, section 6.1). The matrix S is
singular along the seven motions of the world (rotation, translation, scale). The covariance is therefore stated in the
gauge of ``calibration.adjustment.gauge``, in which these motions are no error of a camera. Lens parameters that were
not estimated get an assumed standard deviation, which is propagated ("consider" covariance: Tapley et al., Statistical
Orbit Determination, 2004, 6.3). With few views the principal point is not estimated. If each camera has its own lens,
distortion is not estimated.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from calibration.adjustment.gauge import (
    effective_pose,
    gauge_projection,
    image_sigma,
    intrinsics_jacobian,
    pose_jacobian,
    subject_points,
    world_motions,
)
from calibration.scene.structure import Structure

LENS = 5  # unknowns of a lens: f, k1, k2, cx, cy
LENS_FROM_NINE = np.zeros((9, LENS))
"""fx fy cx cy k1 k2 p1 p2 k3 from f k1 k2 cx cy: one focal length is both."""
LENS_FROM_NINE[[0, 1, 4, 5, 2, 3], [0, 0, 1, 2, 3, 4]] = 1.0
CENTRE_SHARE = 0.01  # of the width: how far principal points lie from the middle, standard deviation; 0.8 % in the
# studio
NOISE_LEAST_PX = 0.1  # of a keypoint: what cameras with few points would otherwise claim
BEND = (0.05, 0.02)  # standard deviations of k1 and k2 about those of the one lens that stands for all
OUTLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Holds the uncertainty of the cameras that structure from motion solved for.

    Attributes:
        blocks: covariance of each camera's pose as a left perturbation (rad, mm), the lens's uncertainty included.
        pose_sigma_px: its size in the image of the subject.
        focal_sigma_px: standard deviation of each focal length.
        noise_px: noise of a keypoint along each axis.
        misfit: the result of ``lens_misfit``; above 1 it enlarges all of the above.
    """

    blocks: Float[np.ndarray, "c 6 6"]
    pose_sigma_px: Float[np.ndarray, " c"]
    focal_sigma_px: Float[np.ndarray, " c"]
    noise_px: float
    misfit: float


def uncertainty(structure: Structure) -> Uncertainty:
    """Computes the covariances of the structure's cameras. The structure's lengths must be in millimetres."""
    rig = structure.rig
    noise = max(NOISE_LEAST_PX, 1.4826 * float(np.median(np.abs(structure.residuals()))))
    places = camera_places(structure)
    size = int(places.max()) + 1
    considered, first = np.unique(places[:, structure.estimated : LENS], return_index=True)
    estimated = np.setdiff1d(np.arange(size), considered)
    system, _ = reduced_camera_system(structure, noise)
    motions = np.zeros((size, 7))
    motions[places[:, LENS:]] = world_motions(rig, scale=True).reshape(len(rig), 6, 7)
    inverse = _inverse(system[np.ix_(estimated, estimated)], motions[estimated])
    width = float(np.mean([camera.intrinsics.width for camera in rig]))
    known = np.array([np.nan, *BEND, CENTRE_SHARE * width, CENTRE_SHARE * width])[structure.estimated :]
    spread = known[first % max(1, len(known))]
    follows = np.zeros((size, len(considered)))
    follows[estimated] = -inverse @ system[np.ix_(estimated, considered)]
    follows[considered] = np.eye(len(considered))
    whole = (follows * spread**2) @ follows.T
    whole[np.ix_(estimated, estimated)] += inverse
    full = _per_camera(whole, places)
    points = subject_points(rig)
    into = np.stack([effective_pose(camera, points) for camera in rig])
    poses = np.einsum("cik,ckdl,djl->cidj", into, full, into).reshape(6 * len(rig), 6 * len(rig))
    projection = gauge_projection(rig, scale=True)
    joint = (projection @ poses @ projection.T).reshape(len(rig), 6, len(rig), 6)
    blocks = np.stack([0.5 * (joint[i, :, i] + joint[i, :, i].T) for i in range(len(rig))])
    focal = np.sqrt(np.array([full[i, 0, i, 0] for i in range(len(rig))]))
    misfit = lens_misfit(structure, noise)
    wider = max(1.0, misfit)
    return Uncertainty(wider * blocks, wider**0.5 * image_sigma(rig, full), wider**0.5 * focal, noise, misfit)


def camera_places(structure: Structure) -> Int[np.ndarray, "c 11"]:
    """Returns, for each camera, the indices of f k1 k2 cx cy and of its six pose parameters among all unknowns."""
    count = len(structure.rig)
    lenses = np.zeros(count, int) if structure.one_lens else np.arange(count)
    lens = LENS * lenses[:, None] + np.arange(LENS)
    return np.hstack([lens, LENS * (lenses.max() + 1) + np.arange(6 * count).reshape(count, 6)])


def lens_misfit(structure: Structure, noise_px: float) -> float:
    """Computes how much better the points would fit if each camera had its own lens. The ratio of fits is about 1 if
    one lens fits all cameras, and larger if the lenses differ.

    The ratio of fits is that of a score test (Rao 1948): the decrease of chi-squared in one Gauss-Newton step, divided
    by the number of added parameters. A wrong lens hardly increases the residuals, because the poses compensate for it.
    """
    if not structure.one_lens or len(structure.rig) < 2:
        return 1.0
    falls = []
    for one in (True, False):
        variant = replace(structure, one_lens=one)
        system, gradient = reduced_camera_system(variant, noise_px)
        places = camera_places(variant)
        free = np.unique(np.hstack([places[:, : structure.estimated], places[:, LENS:]]))
        motions = np.zeros((len(gradient), 7))
        motions[places[:, LENS:]] = world_motions(variant.rig, scale=True).reshape(len(variant.rig), 6, 7)
        step = _inverse(system[np.ix_(free, free)], motions[free]) @ gradient[free]
        falls.append(float(gradient[free] @ step))
    return (falls[1] - falls[0]) / (structure.estimated * (len(structure.rig) - 1))


def reduced_camera_system(
    structure: Structure, noise_px: float
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """Returns the matrix ``S`` of the module's docstring, for keypoints with noise ``noise_px`` along each axis. Also
    returns half the gradient of chi-squared by the cameras' parameters. Outliers are left out."""
    places = camera_places(structure)
    size, count = int(places.max()) + 1, len(structure.points)
    u, v = np.zeros((size, size)), np.zeros((count, 3, 3))
    rows, columns, values = [], [], []
    misses = structure.residuals() / noise_px
    slope, pull = np.zeros(size), np.zeros((count, 3))
    good = (np.abs(misses) < OUTLIER_SIGMAS).all(axis=1)
    for index, camera in enumerate(structure.rig):
        of_camera = good & (structure.camera_of == index)
        seen = structure.point_of[of_camera]
        points = structure.points[seen]
        by_lens = intrinsics_jacobian(camera, points) @ LENS_FROM_NINE
        by_camera = np.concatenate([by_lens, pose_jacobian(camera, points)], axis=2) / noise_px
        by_point = camera.project_with_jacobian(points)[1] / noise_px
        u[np.ix_(places[index], places[index])] += np.einsum("nki,nkj->ij", by_camera, by_camera)
        np.add.at(v, seen, np.einsum("nki,nkj->nij", by_point, by_point))
        slope[places[index]] += np.einsum("nki,nk->i", by_camera, misses[of_camera])
        np.add.at(pull, seen, np.einsum("nki,nk->ni", by_point, misses[of_camera]))
        shape = (len(seen), LENS + 6, 3)
        values.append(np.einsum("nki,nkj->nij", by_camera, by_point).ravel())
        rows.append(np.broadcast_to(places[index][None, :, None], shape).ravel())
        columns.append(np.broadcast_to(3 * seen[:, None, None] + np.arange(3), shape).ravel())
    held = np.linalg.matrix_rank(v) == 3  # a point that two good observations no longer hold says nothing
    inverse = np.zeros_like(v)
    inverse[held] = np.linalg.inv(v[held])
    at = np.concatenate(rows), np.concatenate(columns)
    w = scipy.sparse.coo_array((np.concatenate(values), at), shape=(size, 3 * count)).tocsr()
    system = u - np.asarray((w @ scipy.sparse.block_diag(list(inverse), format="csr") @ w.T).todense())
    return system, slope - w @ np.einsum("nij,nj->ni", inverse, pull).ravel()


def _inverse(matrix: Float[np.ndarray, "p p"], motions: Float[np.ndarray, "p 7"]) -> Float[np.ndarray, "p p"]:
    """Returns the inverse of the reduced camera system, restricted so that ``motions``, its null space, are zero."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    held = np.linalg.qr(motions / scale[:, None])[0]
    inverse = np.linalg.inv(matrix * np.outer(scale, scale) + held @ held.T) - held @ held.T
    return inverse * np.outer(scale, scale)


def _per_camera(
    covariance: Float[np.ndarray, "p p"], places: Int[np.ndarray, "c 11"]
) -> Float[np.ndarray, "c 15 c 15"]:
    """Returns the covariance rearranged by camera: nine lens values, then six values of the pose."""
    count = len(places)
    expand = np.zeros((count, 15, len(covariance)))
    for index in range(count):
        expand[index][:9, places[index, :LENS]] = LENS_FROM_NINE
        expand[index][9:, places[index, LENS:]] = np.eye(6)
    flat = expand.reshape(15 * count, -1)
    return (flat @ covariance @ flat.T).reshape(count, 15, count, 15)
