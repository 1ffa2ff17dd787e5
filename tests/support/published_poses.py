"""How a calibration agrees with projection matrices that others published, after a similarity of the world."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from calibration.scene.structure import Structure
from rig.geometry import rotation_from_vector

MOST = 20_000  # observations compared, drawn at random


@dataclass(frozen=True, slots=True)
class Agreement:
    """Distances (px) in the pictures between where ours and the published matrices put the same points of the scene:
    over all observations, and the mean of the worst camera."""

    mean_px: float
    median_px: float
    p95_px: float
    worst_camera: str
    worst_camera_px: float


def read_projections(path: Path, scale: float = 1.0) -> dict[str, Float[np.ndarray, "3 4"]]:
    """Matrices by picture, for pictures ``scale`` times as large; pixel (0, 0) is a pixel's centre."""
    shift = (scale - 1) / 2
    resized = np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])
    matrices = json.loads(path.read_text(encoding="utf-8"))
    return {name: resized @ np.array(matrix) for name, matrix in matrices.items()}


def agreement(structure: Structure, published: dict[str, Float[np.ndarray, "3 4"]]) -> Agreement:
    """The similarity is the one of least distances in the pictures (soft L1), started from the cameras' centres."""
    names = structure.rig.names
    matrices = np.stack([published[name] for name in names])
    ours = np.stack([camera.centre_world for camera in structure.rig])
    theirs = np.stack([-np.linalg.solve(matrix[:, :3], matrix[:, 3]) for matrix in matrices])
    here, there = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    u, values, vt = np.linalg.svd(there.T @ here)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = (u * sign) @ vt, (values * sign).sum() / (here**2).sum()
    good = np.flatnonzero(np.linalg.norm(structure.residuals(), axis=1) < 4.0)
    pick = np.random.default_rng(0).choice(good, min(MOST, len(good)), replace=False)
    camera_of, points = structure.camera_of[pick], structure.points[structure.point_of[pick]] - ours.mean(axis=0)
    mine = structure.pixels[pick] + structure.residuals()[pick]

    def misses(step: np.ndarray) -> Float[np.ndarray, "n 2"]:
        moved = np.exp(step[6]) * scale * points @ (rotation_from_vector(step[:3]) @ rotation).T
        moved = moved + theirs.mean(axis=0) + step[3:6]
        image = np.einsum("nij,nj->ni", matrices[camera_of, :, :3], moved) + matrices[camera_of, :, 3]
        return image[:, :2] / image[:, 2:] - mine

    found = least_squares(lambda step: misses(step).ravel(), np.zeros(7), loss="soft_l1", x_scale=1e-3)
    away = np.linalg.norm(misses(found.x), axis=1)
    means = [float(away[camera_of == index].mean()) for index in range(len(names))]
    worst = int(np.argmax(means))
    return Agreement(
        float(away.mean()), float(np.median(away)), float(np.quantile(away, 0.95)), names[worst], means[worst]
    )
