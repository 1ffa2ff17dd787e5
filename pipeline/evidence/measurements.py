"""Measures anthropometric landmarks and distances of a fitted head, with standard deviations by linear propagation.

A landmark is a vertex of the model's full mesh, with the position ``x = s R (h0 + sum_m z_m h_m) + t`` (the paper's eq.
1). The landmark's derivatives are ``s R h_m`` by a coefficient, ``-[x - t]x`` by a rotation about the head's origin,
the identity by the translation, and ``x - t`` by log scale. A distance has ``var = g C g^T``, where g is its gradient
and C the fit's covariance. Rotation and translation of the head do not change a distance between landmarks.

Outlines and photographs of skin hardly determine a landmark's position along the surface. The eigenheads determine this
position, but most heads are not exact combinations of eigenheads. Therefore a landmark has the standard deviation
``Fit.sliding_mm`` in every direction of its tangent plane. The kernel of ``gaussian_process`` gives the correlation of
two landmarks, which decreases with their distance.

Definitions follow Farkas, *Anthropometry of the Head and Face* (1994). Head length and breadth need three more points
on the fitted head. The opisthocranion is the point of the back of the head farthest from the glabella in the
midsagittal plane; the euryons are the most lateral points of the skull above the ears. Head length and breadth are
extremal at these three points, so to first order their variance does not depend on the exact points. Face-only models
have no head length and breadth.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.fit import Fit
from pipeline.head_model.gaussian_process import SCALES
from pipeline.head_model.model import HeadModel
from rig.geometry import cross_matrix
from rig.mesh import vertex_normals

Vertices = Float[np.ndarray, "v 3"]
Points = Float[np.ndarray, "n 3"]

DISTANCES: Mapping[str, tuple[str, str]] = {
    "head_breadth": ("euryon_right", "euryon_left"),
    "head_length": ("glabella", "opisthocranion"),
    "minimum_frontal_breadth": ("frontotemporale_right", "frontotemporale_left"),
    "bizygomatic_breadth": ("zygion_right", "zygion_left"),
    "bigonial_breadth": ("gonion_right", "gonion_left"),
    "bitragion_breadth": ("tragion_right", "tragion_left"),
    "face_height": ("nasion", "gnathion"),
    "lower_face_height": ("subnasale", "gnathion"),
    "nose_length": ("nasion", "subnasale"),
    "nose_breadth": ("alare_right", "alare_left"),
    "nose_protrusion": ("subnasale", "pronasale"),
    "biocular_breadth": ("exocanthion_right", "exocanthion_left"),
    "intercanthal_breadth": ("endocanthion_right", "endocanthion_left"),
    "eye_fissure_length_right": ("exocanthion_right", "endocanthion_right"),
    "eye_fissure_length_left": ("exocanthion_left", "endocanthion_left"),
    "mouth_breadth": ("cheilion_right", "cheilion_left"),
    "vermilion_height": ("labiale_superius", "labiale_inferius"),
}
EURYON_ABOVE_GLABELLA_MM = 10.0  # Farkas: the ears end at the height of the brows, so that none is above this
CRANIUM_BEHIND_TRAGION_MM = 40.0  # half of what the smallest adult skull has there; less is a face without a cranium
MIDSAGITTAL_MM = 5.0  # half width of the band that stands for the midsagittal plane, one edge length of the models


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """Holds a point in the world frame and the standard deviation of each coordinate (mm; None if unknown)."""

    position_mm: Float[np.ndarray, " 3"]
    std_mm: Float[np.ndarray, " 3"] | None

    def widen_by_scale(self, sigma: float, centre: Float[np.ndarray, " 3"]) -> "Landmark":
        """Adds the relative standard deviation ``sigma`` of the head's scale about ``centre`` (mm) to the landmark."""
        off = sigma * (self.position_mm - centre)
        return Landmark(self.position_mm, None if self.std_mm is None else np.hypot(self.std_mm, off))


@dataclass(frozen=True, slots=True)
class Measurement:
    """Holds a length and its standard deviation (mm; None if the fit has no covariance)."""

    value_mm: float
    std_mm: float | None

    def widen_by_scale(self, sigma: float) -> "Measurement":
        """Adds the relative standard deviation ``sigma`` of the head's scale to the length's."""
        std = None if self.std_mm is None else float(np.hypot(self.std_mm, sigma * self.value_mm))
        return Measurement(self.value_mm, std)


def landmarks(model: HeadModel, fit: Fit, vertices: Vertices | None = None) -> dict[str, Landmark]:
    """Returns the model's landmarks on the fitted head, world frame, mm. If the head was deformed after the fit,
    ``vertices`` is the final head (full mesh, world frame, mm). The measurements' standard deviations are always
    computed from the fit."""
    names = list(model.landmarks)
    index = np.array([model.landmarks[name] for name in names])
    points, jacobian = _points(model, fit, index)
    points = points if vertices is None else vertices[index]
    if fit.covariance is None:
        return {name: Landmark(point, None) for name, point in zip(names, points, strict=True)}
    variance = np.einsum("nip,pq,niq->ni", jacobian, fit.covariance, jacobian)
    normals = _normals(model, fit, vertices)[index]
    variance += fit.sliding_mm**2 * (1.0 - normals**2)
    std = np.sqrt(np.maximum(variance, 0.0))
    return {name: Landmark(points[i], std[i]) for i, name in enumerate(names)}


def measurements(model: HeadModel, fit: Fit, vertices: Vertices | None = None) -> dict[str, Measurement]:
    """Returns every distance of ``DISTANCES`` (mm) whose end points the model has, with its standard deviation. If the
    head was deformed after the fit, ``vertices`` is the final head (full mesh, world frame, mm)."""
    rows = dict(model.landmarks) | _cranial_points(model, fit)
    found = {name: ends for name, ends in DISTANCES.items() if ends[0] in rows and ends[1] in rows}
    index = np.array([[rows[a], rows[b]] for a, b in found.values()], int).reshape(-1)
    points, jacobian = _points(model, fit, index)
    points = points if vertices is None else vertices[index]
    chords = points[1::2] - points[::2]
    values = np.linalg.norm(chords, axis=1)
    if fit.covariance is None:
        return {name: Measurement(float(value), None) for name, value in zip(found, values, strict=True)}
    units = chords / np.maximum(values, 1e-9)[:, None]
    gradients = np.einsum("ni,nip->np", units, jacobian[1::2] - jacobian[::2])
    variances = np.einsum("np,pq,nq->n", gradients, fit.covariance, gradients)
    normals = _normals(model, fit, vertices)[index]
    variances += fit.sliding_mm**2 * _sliding_apart(units, values, normals[::2], normals[1::2])
    stds = np.sqrt(np.maximum(variances, 0.0))
    return {name: Measurement(float(values[i]), float(stds[i])) for i, name in enumerate(found)}


def _normals(model: HeadModel, fit: Fit, vertices: Vertices | None) -> Vertices:
    """Returns the vertex normals (world frame) of the mesh ``vertices``; None means the fitted head."""
    head = fit.world_from_head.apply(model.vertices(fit.coefficients)) if vertices is None else vertices
    return vertex_normals(head, model.levels["full"].faces)


def _sliding_apart(
    units: Points, lengths_mm: Float[np.ndarray, " n"], first_normals: Points, second_normals: Points
) -> Float[np.ndarray, " n"]:
    """Returns the variance of distances, along the directions ``units``, between points that shift in their tangent
    planes with unit variance. Shifts of points near each other are correlated."""
    first, second = (
        units - normals * (units * normals).sum(axis=1, keepdims=True) for normals in (first_normals, second_normals)
    )
    alike = sum(s.amplitude_mm**2 * np.exp(-0.5 * (lengths_mm / s.length_mm) ** 2) for s in SCALES)
    alike = alike / sum(s.amplitude_mm**2 for s in SCALES)
    return (first**2).sum(axis=1) + (second**2).sum(axis=1) - 2.0 * alike * (first * second).sum(axis=1)


def _points(model: HeadModel, fit: Fit, vertices: np.ndarray) -> tuple[Points, Float[np.ndarray, "n 3 p"]]:
    """Returns the world positions of vertices of the full mesh, and their derivatives by the parameters of ``Fit`` in
    its order."""
    place = fit.world_from_head
    count = len(fit.coefficients)
    basis = model.basis("full", count, vertices).astype(float)
    mean = model.levels["full"].operator[vertices] @ model.mean.astype(float)
    points = place.apply(mean + np.einsum("m,mni->ni", fit.coefficients, basis))
    by_shape = np.einsum("ij,mnj->nim", place.scale * place.rotation, basis)
    arms = points - place.translation
    by_rotation = -cross_matrix(arms)
    by_translation = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return points, np.concatenate([by_shape, by_rotation, by_translation, arms[:, :, None]], axis=2)


def _cranial_points(model: HeadModel, fit: Fit) -> dict[str, int]:
    """Finds the vertices of the right and left euryon and the opisthocranion; empty for models without a cranium."""
    if not {"glabella", "tragion_right", "tragion_left"} <= set(model.landmarks):
        return {}
    head = model.vertices(fit.coefficients)
    glabella = head[model.landmarks["glabella"]]
    _, tragion_y, tragion_z = head[[model.landmarks["tragion_right"], model.landmarks["tragion_left"]]].mean(axis=0)
    behind = (head[:, 2] < tragion_z - CRANIUM_BEHIND_TRAGION_MM) & (head[:, 1] > tragion_y)  # no nape, no back
    middle = np.flatnonzero(behind & (np.abs(head[:, 0] - glabella[0]) < MIDSAGITTAL_MM))
    skull = np.flatnonzero((head[:, 1] > glabella[1] + EURYON_ABOVE_GLABELLA_MM) & (head[:, 2] < tragion_z + 20.0))
    if not len(middle) or not len(skull):
        return {}
    far = middle[np.argmax(np.linalg.norm(head[middle] - glabella, axis=1))]
    right, left = skull[np.argmin(head[skull, 0])], skull[np.argmax(head[skull, 0])]
    return {"euryon_right": int(right), "euryon_left": int(left), "opisthocranion": int(far)}
