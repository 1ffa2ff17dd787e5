"""Which patches of the face lie under hair: its surface is not the head's, yet photographs see it sharply.

What hair looks like is known from where it cannot be anything else: inside the silhouette, outside the fitted head,
above the chin. What skin looks like is known from the middle of the face, and in shadow from below jaw and chin.
Colours of both, as histograms over all views, tell for every sample which of the two it shows more likely. Brows, beard
and pupils may have hair's colours too: hair is what hangs together with the border of the face region, and never what
looks down.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pipeline.eigenheads.model import HeadModel
from pipeline.fitting.photo.patches import Patches
from rig.mesh import vertex_normals

BINS, BIN_BLUR = 16, 1.0  # of a channel; the light's slope over the face moves a colour by about one bin
LEAST_PIXELS = 2000  # of hair over all views: fewer are edges of the mask
OUTSIDE_PX, INSIDE_PX = 5, 3.0  # from the fitted head's outline, from the input's contour
MIDDLE_MM, BORDER_MM = 15.0, 6.0  # from the face region's border: skin, by far most of it; where hair comes in
DOWNWARD = -0.3  # cosine between normal and up: no hair grows there, and light from above leaves it dark
ODDS = 1.0  # log odds that hair must show: most of the face is none
HAIR_SHARE = 0.3  # of a patch's samples
REACH_MM = 5.0  # a patch so near to hair still holds some of it


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """One view of the fitted head: where the head is, the input's signed distance (px), and which way is up."""

    image: UInt8[np.ndarray, "h w 3"]
    covered: Bool[np.ndarray, "h w"]
    distance: Float32[np.ndarray, "h w"]
    pixels: Float[np.ndarray, "s 2"]  # of all samples
    seen: Bool[np.ndarray, " s"]
    chin: Float[np.ndarray, " 2"]
    up: Float[np.ndarray, " 2"]  # direction in the image


def under_hair(model: HeadModel, patches: Patches, sights: list[Sight]) -> Bool[np.ndarray, " c"]:
    """The patches that show hair, or are about to."""
    rest = np.zeros(len(patches.centre), bool)
    vertices = model.vertices(np.zeros(0))
    downward = patches.normals(vertex_normals(vertices, model.levels["full"].faces))[:, 1] < DOWNWARD
    inward = depth_in_face(model)
    bare = (patches.mixed(inward) > MIDDLE_MM) | downward
    hair = np.concatenate([_strange(sight) for sight in sights]) if sights else np.zeros((0, 3), np.uint8)
    skin = [s.image[tuple(_rounded(s.pixels[s.seen & bare]).T[::-1])] for s in sights]
    if len(hair) < LEAST_PIXELS or not sum(len(colours) for colours in skin):
        return rest
    favour = np.log(histogram(hair)) - np.log(histogram(np.concatenate(skin)))
    votes, views = np.zeros(len(bare)), np.zeros(len(bare))
    for sight in sights:
        at = _rounded(sight.pixels[sight.seen])
        votes[sight.seen] += favour[tuple((sight.image[at[:, 1], at[:, 0]] // (256 // BINS)).T)] > ODDS
        views[sight.seen] += 1
    share = patch_mean(patches, votes / np.maximum(views, 1), views > 0)
    share[patch_mean(patches, downward.astype(float), np.ones(len(bare), bool)) > 0.5] = 0.0
    centres = vertices[patches.centre]
    return spread_from_border(centres, share > HAIR_SHARE, inward[patches.centre] < BORDER_MM)


def depth_in_face(model: HeadModel) -> Float[np.ndarray, " v"]:
    """Distance (mm) of every vertex of the full level to what is not face; taken on the cage, where it is as smooth."""
    points, cage = model.mean.astype(float), model.levels["cage"]
    distance, _ = KDTree(points[~cage.face_region]).query(points)
    return model.levels["full"].operator @ distance


def histogram(colours: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "b b b"]:
    """Probability of each colour bin, smoothed, nowhere zero."""
    counts = np.zeros((BINS, BINS, BINS), np.float32)
    np.add.at(counts, tuple((colours // (256 // BINS)).T), 1.0)
    for axis in range(3):
        flat = np.moveaxis(counts, axis, 0).reshape(BINS, -1)
        smooth = cv2.GaussianBlur(flat, (1, 7), sigmaX=0.1, sigmaY=BIN_BLUR, borderType=cv2.BORDER_REPLICATE)
        counts = np.moveaxis(smooth.reshape(BINS, BINS, BINS), 0, axis)
    return (counts.astype(float) + 1e-4 * len(colours) / BINS**3) / (len(colours) * (1 + 1e-4))


def patch_mean(
    patches: Patches, values: Float[np.ndarray, " s"], known: Bool[np.ndarray, " s"]
) -> Float[np.ndarray, " c"]:
    """Mean over each patch's known samples; 0 where none is known."""
    total = patches.sums(patches.agreement, np.stack([values * known, known], axis=1).astype(float))
    return total[:, 0] / np.maximum(total[:, 1], 1e-9)


def spread_from_border(
    centres: Float[np.ndarray, "c 3"], hair: Bool[np.ndarray, " c"], border: Bool[np.ndarray, " c"]
) -> Bool[np.ndarray, " c"]:
    """Patches near hair that hangs together with the border."""
    rows = np.flatnonzero(hair)
    if not len(rows):
        return np.zeros(len(centres), bool)
    pairs = KDTree(centres[rows]).query_pairs(REACH_MM, output_type="ndarray")
    links = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    _, label = connected_components(links, directed=False)
    grown = rows[np.isin(label, label[border[rows]])]
    if not len(grown):
        return np.zeros(len(centres), bool)
    return KDTree(centres[grown]).query(centres)[0] < REACH_MM


def _strange(sight: Sight) -> UInt8[np.ndarray, "n 3"]:
    """Pixels of the subject that the head does not cover, above its chin."""
    size = 2 * OUTSIDE_PX + 1
    near = cv2.dilate(sight.covered.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    rows, columns = np.nonzero((sight.distance < -INSIDE_PX) & ~near)
    above = (columns - sight.chin[0]) * sight.up[0] + (rows - sight.chin[1]) * sight.up[1] > 0
    return sight.image[rows[above], columns[above]]


def _rounded(pixels: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
    return np.rint(pixels).astype(int)
