"""Measures how many vertices of head.ply carry another part's colour: hair's on ears, cloth's on the neck, the wall's.

The truth says where skin, hair and clothes are seen, and the photographs what colours they have there: each true point
has that of the view that it faces most. A vertex is wrong if its colour is unlike the skin about it, and much more like
hair or clothes about it, or like the backdrop. On forehead, jaw and neck, hair has a right to its colour where it is
the nearest that is seen, or grows.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import KDTree

from pipeline.geometry.projection import camera_depths, project_points
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions, pinnae
from pipeline.results.reconstruction import Reconstruction
from rig.mesh import Mesh
from tests.laboratory.experiments.paper.detail import Known

UNLIKE = 15.0  # colour difference (CIE 1976) from skin: shading and gains of cameras differ by less
MORE_LIKE = 0.5  # of that difference, to another part
THINNED, ABOUT, REACH_MM = 8, 128, 60.0  # of a part's points, those compared, and how far hair and clothes may lie
OUTLIERS = 5  # of the compared points: the truth is seen past strands
BACKDROP_STEP, MARGIN_PX = 16, 19  # of the pixels that are compared, and how far off the subject
ON_MM = 5.0  # of a strand: hair grows there
CELL_PX, HIDDEN_MM = 6, 6.0  # a point that lies so far behind another one of its cell is hidden
HEAD, HAIR, CLOTHES = range(3)  # codes of the truth's parts


def wrong_colours(known: Known, found: Reconstruction, model: HeadModel) -> dict[str, float]:
    """Returns the share of wrong vertices of ears, forehead, jaw and neck."""
    mesh, true, lab = found.mesh_world, known.visible, _lab(_point_colours(known))
    shown = _lab(found.texturing.vertices.colours)
    rows = {part: np.flatnonzero(true.part == part)[::THINNED] for part in (HEAD, HAIR, CLOTHES)}
    unlike = {part: _unlike(shown, mesh, true.points[at], lab[at]) for part, at in rows.items()}
    unlike_skin, other = unlike[HEAD][0], KDTree(_lab(_backdrop(known, found))).query(shown)[0]
    for part in (HAIR, CLOTHES):
        other = np.minimum(other, np.where(unlike[part][1] < REACH_MM, unlike[part][0], np.inf))
    wrong = (unlike_skin > UNLIKE) & (other < MORE_LIKE * unlike_skin)
    grown = unlike[HAIR][1] < np.maximum(unlike[HEAD][1], ON_MM)
    regions, height = head_regions(model), model.vertices(np.zeros(0))[:, 1]
    brow, chin = (height[model.landmarks[name]] for name in ("glabella", "sublabiale"))
    places = {"forehead": regions["face"] & (height > brow + 8.0), "jaw": regions["face"] & (height < chin)}
    places = {name: place & ~grown for name, place in (places | {"neck": regions["neck"]}).items()}
    places["ears"] = pinnae(model)
    return {f"head_{name}_wrong": float(wrong[at].mean()) for name, at in places.items() if at.any()}


def _unlike(
    shown: Float[np.ndarray, "v 3"], mesh: Mesh, points: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Returns how unlike each vertex is to the most alike of a part's points about it but for outliers, and how far the
    nearest point is."""
    if len(points) < ABOUT:
        return np.full(len(shown), np.inf), np.full(len(shown), np.inf)
    far, near = KDTree(points).query(mesh.vertices, ABOUT)
    unlike = np.linalg.norm(colours[near] - shown[:, None], axis=2)
    return np.partition(unlike, OUTLIERS, axis=1)[:, OUTLIERS], far[:, 0]


def _point_colours(known: Known) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of the true points in the views that they face most."""
    points, normals = known.visible.points.astype(float), known.visible.normals
    best, out = np.zeros(len(points)), np.zeros((len(points), 3), np.uint8)
    for camera in known.rig:
        image, towards = known.capture.images[camera.name], camera.centre_world - points
        facing = np.einsum("nx,nx->n", normals, towards) / np.linalg.norm(towards, axis=1)
        at = np.rint(project_points(camera, points)).astype(int)
        framed = np.asarray(((at >= 0) & (at < np.array(image.shape[1::-1]))).all(axis=1))
        depth, cell = camera_depths(camera, points), np.where(framed[:, None], at, 0) // CELL_PX
        nearest = np.full(cell.max(axis=0) + 1, np.inf)
        np.minimum.at(nearest, tuple(cell[framed].T), depth[framed])
        better = framed & (facing > best) & (depth < nearest[tuple(cell.T)] + HIDDEN_MM)
        best[better], out[better] = facing[better], image[at[better, 1], at[better, 0]]
    return out


def _backdrop(known: Known, found: Reconstruction) -> UInt8[np.ndarray, "m 3"]:
    """Returns colours beside the subject."""
    kernel = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    beside = {
        name: np.asarray(cv2.dilate(view.mask.view(np.uint8), kernel)) == 0
        for name, view in found.views.silhouettes.items()
    }
    return np.concatenate([known.capture.images[name][mask][::BACKDROP_STEP] for name, mask in beside.items()])


def _lab(colours: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return cv2.cvtColor((colours / np.float32(255.0))[None], cv2.COLOR_RGB2LAB)[0]
