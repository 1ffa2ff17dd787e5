"""Closes the eyes of the head model where the photographs show closed eyes.

The pixels between the lids show whether an eye is open: the white of an eye is grey, and iris and pupil are darker than
skin. A closed lid is skin with a thin line of lashes. A blink expression of the model closes the lids. In a model
without such an expression, a smooth surface bridges the opening and replaces the lids' margins (biharmonic; Botsch and
Kobbelt 2004, *An intuitive framework for real-time freeform modeling*). Later steps deform the bridge to the measured
lids. The model's eyeball stays hidden behind the bridge.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.compute.trace import traced
from pipeline.detail.smooth_field import smooth_field
from pipeline.estimation.positive_definite import factorised
from pipeline.faces.eyes import MAX_CLOSED_OPENING, MIN_HALF_OPENING
from pipeline.head_model.model import HeadModel
from rig.mesh import vertex_normals
from rig.rig import Rig

Photograph = UInt8[np.ndarray, "h w 3"]

Vertices = Float[np.ndarray, "v 3"]

SIDES = ("right", "left")
MARGIN_MM = 2.0  # beyond the corners of the eye
BRIDGE_HEIGHT, BRIDGE_RAISED = 0.36, 0.05  # half height and middle of the bridge, by the fissure's length: up to the
# fold
SHOWN_LENGTH, SHOWN_HEIGHT = 0.5, 0.3  # where an open eye is looked for, by its length: a fit may be 4 mm off; no brow
SKIN_BELOW, SKIN_SIZE = 0.75, 0.25  # where skin is looked at, by the fissure's length
VIEWS, MIN_FACING = 5, 0.6  # the most frontal cameras
WHITE_CHROMA, WHITE_LIGHT, DARK_LIGHT = 0.5, 0.6, 0.35  # by the skin's
WHITE_SHARE, DARK_SHARE = 0.05, 0.1  # of what is looked at; lashes of a closed eye are a line
MIN_VERTICES = 12


@dataclass(frozen=True, slots=True)
class EyeEvidence:
    """Holds an eye's appearance in the photographs: the fractions (0 to 1) of the opening that are white and dark, and
    the relative distance between the lids if a face was found (``faces.eyes.eye_openings``)."""

    white: float
    dark: float
    views: int
    opening: float | None = None

    @property
    def is_surely_closed(self) -> bool:
        """Returns True if the measured opening is smaller than that of any half-closed eye."""
        return self.opening is not None and self.opening < MIN_HALF_OPENING

    @property
    def is_surely_open(self) -> bool:
        """Returns True if the measured opening is larger than that of any closed eye."""
        return self.opening is not None and self.opening > MAX_CLOSED_OPENING

    @property
    def closed(self) -> bool:
        """Returns True if the lids certainly touch, or if a view shows neither white nor dark pixels between them and
        the eye is not certainly open."""
        nothing = self.views > 0 and self.white < WHITE_SHARE and self.dark < DARK_SHARE
        return self.is_surely_closed or (nothing and not self.is_surely_open)


@dataclass(frozen=True, slots=True, eq=False)
class Fissure:
    """Holds the slit between the lids of one eye on the mean head: its length, and the position of every vertex along
    the slit and above it (mm), relative to the slit's middle."""

    length_mm: float
    along: Float[np.ndarray, " v"]  # mm from the middle, towards the corners
    above: Float[np.ndarray, " v"]
    front: Bool[np.ndarray, " v"]

    def ellipse(self, half_length: float, half_height: float, below: float = 0.0) -> Bool[np.ndarray, " v"]:
        """Returns a mask of the vertices inside an ellipse (half axes in mm), whose centre lies ``below`` mm under the
        middle of the slit."""
        inside = (self.along / half_length) ** 2 + ((self.above + below) / half_height) ** 2 < 1.0
        return self.front & inside


def eye_fissure(model: HeadModel, side: str) -> Fissure:
    """Returns the slit between the lids of the eye on one ``side``, ``right`` or ``left``."""
    mean = model.vertices(np.zeros(0))
    outer, inner = (mean[model.landmarks[f"{corner}canthion_{side}"]] for corner in ("exo", "endo"))
    chord = inner - outer
    along = chord * (1.0, 1.0, 0.0) / np.linalg.norm(chord[:2])
    above = np.array([-along[1], along[0], 0.0]) * np.sign(along[0])
    off = mean - 0.5 * (outer + inner)
    front = (np.abs(off[:, 2]) < np.linalg.norm(chord)) & (np.abs(off[:, 0]) < np.linalg.norm(chord))
    return Fissure(float(np.linalg.norm(chord)), off @ along, off @ above, front)


@traced
def measure_eye_appearance(
    model: HeadModel, vertices: Vertices, images: Mapping[str, Photograph], rig: Rig, openings: Mapping[str, float]
) -> dict[str, EyeEvidence]:
    """Measures the appearance between the lids of each eye (``right``, ``left``) in the photographs.

    ``model``: the head model. ``vertices``: the fitted head, full mesh, world frame, mm. ``images``: photographs by
    camera, sRGB. ``rig``: the cameras. ``openings``: relative distance between the lids of the detected face, by side.
    """
    normals = vertex_normals(vertices, model.levels["full"].faces)
    found = {}
    for side in SIDES:
        slit = eye_fissure(model, side)
        shown = np.flatnonzero(slit.ellipse(SHOWN_LENGTH * slit.length_mm, SHOWN_HEIGHT * slit.length_mm))
        size = SKIN_SIZE * slit.length_mm
        skin = np.flatnonzero(slit.ellipse(1.5 * size, size, SKIN_BELOW * slit.length_mm))
        shares = [
            _shares(images[name], rig[name].project(vertices[shown]), rig[name].project(vertices[skin]))
            for name in _facing(vertices[shown], normals[skin], images, rig)
        ]
        shares = [each for each in shares if each is not None]
        white, dark = np.median(shares, axis=0) if shares else (0.0, 0.0)
        found[side] = EyeEvidence(float(white), float(dark), len(shares), openings.get(side))
    return found


def _facing(
    places: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "m 3"], images: Mapping[str, Photograph], rig: Rig
) -> list[str]:
    """Returns the names of the cameras, at most ``VIEWS``, that see the eye most frontally."""
    if not len(places) or not len(normals):
        return []
    middle, outward = places.mean(axis=0), normals.mean(axis=0)
    outward /= max(float(np.linalg.norm(outward)), 1e-9)
    names = [name for name in rig.names if name in images]
    towards = np.array([rig[name].centre_world - middle for name in names])
    cosine = towards @ outward / np.linalg.norm(towards, axis=1)
    order = np.argsort(-cosine, kind="stable")[:VIEWS]
    return [names[k] for k in order if cosine[k] > MIN_FACING]


def _shares(
    image: Photograph, opening: Float[np.ndarray, "n 2"], skin: Float[np.ndarray, "m 2"]
) -> tuple[float, float] | None:
    """Returns the white and the dark fraction of the opening, compared with the skin around it. Returns None if too
    little of opening or skin lies inside the photograph."""
    eye, about = _colours(image, opening), _colours(image, skin)
    if len(eye) < MIN_VERTICES or len(about) < MIN_VERTICES:
        return None
    light, chroma = _light_and_chroma(eye)
    skin_light, skin_chroma = (float(np.median(values)) for values in _light_and_chroma(about))
    white = (chroma < WHITE_CHROMA * skin_chroma) & (light > WHITE_LIGHT * skin_light)
    return float(white.mean()), float((light < DARK_LIGHT * skin_light).mean())


def _colours(image: Photograph, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 3"]:
    at = np.rint(pixels)
    inside = (at >= 0).all(axis=1) & (at < image.shape[1::-1]).all(axis=1)
    column, row = at[inside].astype(int).T
    return (image[row, column] / 255.0) ** 2.2


def _light_and_chroma(colours: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Returns the linear light of each colour, and (red - blue) / light, which is about 0 for grey and white."""
    light = colours.mean(axis=1)
    return light, (colours[:, 0] - colours[:, 2]) / np.maximum(light, 1e-3)


def _lids(slit: Fissure) -> Int[np.ndarray, " r"]:
    """Returns a mask of the vertices of the two lids and of the surface between them."""
    half_length, half_height = 0.5 * slit.length_mm + MARGIN_MM, BRIDGE_HEIGHT * slit.length_mm
    return np.flatnonzero(slit.ellipse(half_length, half_height, -BRIDGE_RAISED * slit.length_mm))


def replace_lids(vertices: Vertices, shape: Vertices, model: HeadModel) -> Vertices:
    """Replaces the lids by those of ``shape``, displaced smoothly to meet the skin around them.

    Displacements along the normals would tear lids, because the normals at the lids' margins point at each other.

    Args:
        vertices: the head's full mesh, mm.
        shape: the same head with eigenheads and expressions only.
        model: the topology.
    """
    moved, faces = vertices - shape, model.levels["full"].faces
    for side in SIDES:
        rows = _lids(eye_fissure(model, side))
        moved[rows] = _smoothest(moved, vertices, faces, rows)
    return shape + moved


def bridge_eyelids(vertices: Vertices, model: HeadModel, closed: frozenset[str]) -> Vertices:
    """Bridges the openings of the eyes ``closed`` (``right``, ``left``) by smooth surfaces. ``vertices`` are the full
    mesh, in any frame, mm."""
    out, faces = vertices.copy(), model.levels["full"].faces
    for side in sorted(closed):
        rows = _lids(eye_fissure(model, side))
        out[rows] = _smoothest(out, vertices, faces, rows)
    return out


def _smoothest(
    values: Vertices, vertices: Vertices, faces: Int[np.ndarray, "f 3"], rows: Int[np.ndarray, " r"]
) -> Float[np.ndarray, "r 3"]:
    """Returns the values at the vertices ``rows`` that minimise the squared Laplacian, with all other vertices
    fixed."""
    inside = np.zeros(len(vertices), bool)
    inside[rows] = True
    for _ in range(2):  # the Laplacian's own reach, squared
        inside[faces[inside[faces].any(axis=1)]] = True
    part = np.flatnonzero(inside)
    place = np.full(len(vertices), -1)
    place[part] = np.arange(len(part))
    local = place[faces[inside[faces].all(axis=1)]]
    field = smooth_field(vertices[part], local, 1e3)  # a length beyond the patch: stiffness alone
    free = np.zeros(len(part), bool)
    free[place[rows]] = True
    # Rows of the Laplacian at the patch's own border lack neighbours, and are left out.
    complete = np.ones(len(part), bool)
    edge = ~inside[faces].all(axis=1) & inside[faces].any(axis=1)
    rim = np.unique(faces[edge])
    complete[place[rim[inside[rim]]]] = False
    laplacian = sparse.csr_array(field.operator)[complete]
    weight = sparse.diags_array(1.0 / field.mass[complete])
    matrix = sparse.csr_array(laplacian.T @ weight @ laplacian)
    right = -(matrix[free][:, ~free] @ values[part][~free])
    solved = factorised(sparse.csc_array(matrix[free][:, free])).solve(right)
    order = np.empty(len(part), int)
    order[free] = np.arange(free.sum())
    return solved[order[place[rows]]]
