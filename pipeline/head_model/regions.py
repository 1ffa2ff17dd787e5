"""Defines named regions of a head for every head model; error figures and the level of detail are given by region.

Regions are defined by distances from landmarks on the mean head, so a region is the same part of the head for any mesh.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import Delaunay, KDTree

from pipeline.compute.array_cache import cached_arrays
from pipeline.head_model.model import HeadModel

REGIONS = ("face", "eyes", "nose", "mouth", "ears", "neck", "cranium")
EYE_MARGIN_MM, EYE_HALF_HEIGHT_MM, EYE_DEPTH_MM = 6.0, 13.0, 20.0  # about the line from corner to corner
NOSE_MARGIN_MM = 4.0
NOSE_BASE_MM, CHIN_HALF_WIDTH_MM = 5.0, 35.0
MOUTH_MARGIN_MM, MOUTH_HALF_HEIGHT_MM = 6.0, 16.0
EAR_BEHIND_MM, EAR_BEFORE_MM, EAR_HALF_HEIGHT_MM, EAR_INSIDE_MM = 36.0, 4.0, 33.0, 12.0
PINNA_OFF_MM, PINNA_REACH_MM = 4.0, 6.0  # off the innermost vertex so near, seen from the side
NECK_BELOW_TRAGION_MM = 30.0
FOREHEAD_ABOVE_GLABELLA_MM = (8.0, 45.0)  # above the brows, which move, and below most hairlines
BRIDGE_HALF_WIDTH_MM, BRIDGE_BELOW_NASION_MM, BRIDGE_DEPTH_MM = 8.0, 12.0, 14.0


@lru_cache(maxsize=2)  # models are few, jobs are many
def head_regions(model: HeadModel) -> dict[str, Bool[np.ndarray, " v"]]:
    """Returns, for each region, a mask of its vertices in the finest mesh. Eyes, nose and mouth are parts of the face;
    all other regions do not overlap."""
    vertices, marks = model.vertices(np.zeros(0)), model.landmarks
    at = {name: vertices[row] for name, row in marks.items()}
    face = model.levels["full"].face_region
    ears = _ears(vertices, at) & ~face
    neck = (vertices[:, 1] < at["tragion_left"][1] - NECK_BELOW_TRAGION_MM) & ~face & ~ears
    eyes = np.zeros(len(vertices), bool)
    for side in ("right", "left"):
        outer, inner = at[f"exocanthion_{side}"], at[f"endocanthion_{side}"]
        half = (0.5 * abs(outer[0] - inner[0]) + EYE_MARGIN_MM, EYE_HALF_HEIGHT_MM, EYE_DEPTH_MM)
        eyes |= _within(vertices, 0.5 * (outer + inner), half)
    wing = 0.5 * abs(at["alare_left"][0] - at["alare_right"][0]) + NOSE_MARGIN_MM
    bridge = 0.5 * (at["nasion"] + at["subnasale"])
    nose = _within(vertices, bridge, (wing, 0.5 * (at["nasion"] - at["subnasale"])[1] + 1.0, 40.0)) & ~eyes
    corners = at["cheilion_left"], at["cheilion_right"]
    half = (0.5 * abs(corners[0][0] - corners[1][0]) + MOUTH_MARGIN_MM, MOUTH_HALF_HEIGHT_MM, 30.0)
    mouth = _within(vertices, at["stomion"], half) & ~nose
    return {
        "face": face,
        "eyes": eyes & face,
        "nose": nose & face,
        "mouth": mouth & face,
        "ears": ears,
        "neck": neck,
        "cranium": ~(face | ears | neck),
    }


def halves_of_face(model: HeadModel) -> tuple[Bool[np.ndarray, " v"], Bool[np.ndarray, " v"]]:
    """Returns two masks of the finest mesh's vertices: the face above the nose's base, which the jaw does not move, and
    mouth with chin."""
    vertices, face = model.vertices(np.zeros(0)), model.levels["full"].face_region
    above = vertices[:, 1] - vertices[model.landmarks["subnasale"], 1]
    upper, lower = above > NOSE_BASE_MM, above < -NOSE_BASE_MM
    return face & upper, face & lower & (np.abs(vertices[:, 0]) < CHIN_HALF_WIDTH_MM)


@lru_cache(maxsize=2)
def pinnae(model: HeadModel) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the finest mesh's vertices that protrude from the head at the ears, seen from the side. (The
    region ``ears`` also contains the scalp around the ears.)"""
    vertices, ears = model.vertices(np.zeros(0)), head_regions(model)["ears"]
    inputs = (vertices, ears, PINNA_OFF_MM, PINNA_REACH_MM)
    return cached_arrays("pinnae", inputs, lambda: {"pinnae": _standing(vertices, ears)}, made_by=())["pinnae"]


def scalp(model: HeadModel) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the finest mesh's vertices that can have hair: cranium and temples, without the pinnae."""
    regions = head_regions(model)
    return (regions["cranium"] | regions["ears"]) & ~pinnae(model)


def _standing(vertices: Float[np.ndarray, "v 3"], ears: Bool[np.ndarray, " v"]) -> Bool[np.ndarray, " v"]:
    found = np.zeros(len(vertices), bool)
    for side in (-1.0, 1.0):
        rows = np.flatnonzero(ears & (side * vertices[:, 0] > 0.0))
        out, flat = side * vertices[rows, 0], vertices[rows, 1:]
        inner = np.array([out[near].min() for near in KDTree(flat).query_ball_point(flat, PINNA_REACH_MM)])
        standing = flat[out - inner > PINNA_OFF_MM]
        if len(standing) > 2:
            found[rows] = Delaunay(standing).find_simplex(flat) >= 0
    return found


def stable_region(model: HeadModel) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the finest mesh's vertices over bone that expression, jaw, weight and teeth hardly move: the
    forehead above the brows and the bridge of the nose. The heads of two visits are aligned with each other on this
    region."""
    vertices = model.vertices(np.zeros(0))
    at = {name: vertices[row] for name, row in model.landmarks.items()}
    low, high = at["glabella"][1] + np.array(FOREHEAD_ABOVE_GLABELLA_MM)
    side, depth = abs(at["frontotemporale_left"][0]), at["frontotemporale_left"][2]
    forehead = (np.abs(vertices[:, 0]) < side) & (vertices[:, 1] > low) & (vertices[:, 1] < high)
    bridge = (np.abs(vertices[:, 0]) < BRIDGE_HALF_WIDTH_MM) & (vertices[:, 1] <= low)
    bridge &= vertices[:, 1] > at["nasion"][1] - BRIDGE_BELOW_NASION_MM
    return (forehead & (vertices[:, 2] > depth - 5.0)) | (bridge & (vertices[:, 2] > at["nasion"][2] - BRIDGE_DEPTH_MM))


def _within(
    vertices: Float[np.ndarray, "v 3"], centre: Float[np.ndarray, " 3"], half_mm: tuple[float, float, float]
) -> Bool[np.ndarray, " v"]:
    return np.all(np.abs(vertices - centre) < half_mm, axis=1)


def _ears(vertices: Float[np.ndarray, "v 3"], at: dict[str, Float[np.ndarray, " 3"]]) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the vertices that protrude from the side of the head around the opening of the ear."""
    found = np.zeros(len(vertices), bool)
    for side in ("right", "left"):
        notch = at[f"tragion_{side}"]
        off = vertices - notch
        outwards = off[:, 0] * np.sign(notch[0]) > -EAR_INSIDE_MM
        high = np.abs(off[:, 1]) < EAR_HALF_HEIGHT_MM
        found |= outwards & high & (off[:, 2] > -EAR_BEHIND_MM) & (off[:, 2] < EAR_BEFORE_MM)
    return found
