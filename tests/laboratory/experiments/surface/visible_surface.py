"""Scores a surface by how much of the visible truth it has, and how right it is, by part.

Recall: distance of every point of the truth (``rig.studio.scene.visible``) to the surface where that faces as it does.
Precision: distance of the surface's own points to the truth, as far as the truth covers them. Distances are to tangent
planes where a sample is close, so that the density of samples has no effect.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.spatial import KDTree

from rig.mesh import Mesh, boundary_edges, vertex_normals
from rig.studio.scene.visible import PARTS, VisiblePoints, sample_surface

Distances = Float[np.ndarray, " n"]
SAMPLE_MM2 = 0.25  # of surface for each of its points
NEIGHBOURS = 8  # samples among which one that faces the same way is looked for
MISSING_MM = 50.0  # counted for a true point that has no such sample
REACH_MM = 25.0  # surface farther from every true point is where nobody looked
PLANE_MM = {"recall": 1.0, "precision": 2.0}  # sideways, within which a sample's tangent plane stands for the surface
MAX_COUNTED = 200_000  # points of the surface for precision: shares are then good to 0.001
NORMALS_WITHIN_MM = 3.0  # where the surface is farther from the truth, its normal is of something else
MIN_POINTS = 100  # of a part, for figures of its own


@dataclass(frozen=True, slots=True, eq=False)
class VisibleScore:
    """Holds ``recall`` and ``precision`` by part: median and 95th percentile (mm), and the shares within 1, 2 and 5 mm.
    Recall has "all", too. ``normals``: median and 95th percentile (degrees) by part, between the normal of a true point
    and that of the nearest vertex, where the surface is within 3 mm."""

    recall: dict[str, dict[str, float]]
    precision: dict[str, dict[str, float]]
    normals: dict[str, dict[str, float]]
    closed: bool

    def flat(self) -> dict[str, float]:
        """Returns one number for each key, for tables: ``recall_hair_within_2mm``."""
        kinds = {"recall": self.recall, "precision": self.precision, "normals": self.normals}
        named = ((f"{kind}_{part}_{key}", value) for kind, parts in kinds.items() for part, figures in parts.items()
                 for key, value in figures.items())  # fmt: skip
        return dict(named) | {"closed": float(self.closed)}


def read_visible(truth: Path) -> VisiblePoints:
    """Reads ``visible.npz`` of a truth folder."""
    with np.load(truth / "visible.npz") as kept:
        return VisiblePoints(kept["points"], kept["normals"], kept["part"], kept["views"])


def score_visible(truth: VisiblePoints, mesh: Mesh) -> VisibleScore:
    """Scores a surface (world frame, mm) as delivered, without any realignment."""
    rng = np.random.default_rng(0)
    points, normals = sample_surface(mesh, SAMPLE_MM2, rng)
    true_points, true_normals = truth.points.astype(float), truth.normals.astype(float)
    far, near = KDTree(points).query(true_points, k=NEIGHBOURS)
    missed = _distances(true_points[:, None], points[near], normals[near], far, PLANE_MM["recall"])
    agree = np.einsum("nkx,nx->nk", normals[near], true_normals) > 0
    recall = np.where(agree, missed, np.inf).min(axis=1)
    recall[np.isinf(recall)] = MISSING_MM
    close = recall < NORMALS_WITHIN_MM
    nearest = KDTree(mesh.vertices).query(true_points[close])[1]
    cosine = np.einsum("nx,nx->n", vertex_normals(mesh.vertices, mesh.faces)[nearest], true_normals[close])
    turned = np.full(len(recall), np.nan)
    turned[close] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    counted = rng.choice(len(points), min(len(points), MAX_COUNTED), replace=False)
    far, near = KDTree(true_points).query(points[counted])
    comparable = (far < REACH_MM) & (np.einsum("nx,nx->n", normals[counted], true_normals[near]) > 0)
    precision = _distances(points[counted], true_points[near], true_normals[near], far, PLANE_MM["precision"])
    of_all = {"all": figures_of(recall)}
    return VisibleScore(
        _by_part(recall, truth.part, np.ones(len(recall), bool)) | of_all,
        _by_part(precision, truth.part[near], comparable),
        {
            name: {"median": float(np.median(turned[of])), "p95": float(np.percentile(turned[of], 95))}
            for code, name in enumerate(PARTS)
            if (of := close & (truth.part == code)).sum() > MIN_POINTS
        },
        len(boundary_edges(mesh.faces)) == 0,
    )


def figures_of(distances: Distances) -> dict[str, float]:
    """Returns median, 95th percentile, and the share within 1, 2 and 5 mm."""
    shares = {f"within_{limit}mm": float((distances <= limit).mean()) for limit in (1, 2, 5)}
    return {"median": float(np.median(distances)), "p95": float(np.percentile(distances, 95))} | shares


def _distances(
    points: Float[np.ndarray, "... 3"],
    samples: Float[np.ndarray, "... 3"],
    normals: Float[np.ndarray, "... 3"],
    far: Float[np.ndarray, "..."],
    plane_mm: float,
) -> Float[np.ndarray, "..."]:
    """To the sample's tangent plane where its foot is near, else to the sample."""
    plane = np.abs(((points - samples) * normals).sum(axis=-1))
    sideways = np.sqrt(np.maximum(far * far - plane * plane, 0.0))
    return np.where(sideways < plane_mm, plane, far)


def _by_part(
    distances: Distances, part: Integer[np.ndarray, " n"], counted: Bool[np.ndarray, " n"]
) -> dict[str, dict[str, float]]:
    chosen = {name: counted & (part == code) for code, name in enumerate(PARTS)}
    return {name: figures_of(distances[of]) for name, of in chosen.items() if of.sum() > MIN_POINTS}
