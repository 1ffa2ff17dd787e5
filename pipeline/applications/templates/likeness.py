"""Fits a head model's shape and pose together to another mesh.

Gauss-Newton minimises the distances from the model's vertices to the tangent planes at their closest points on the mesh
(Chen and Medioni 1992), under the prior z ~ N(0, I) of the model's coefficients. The coefficients are those of
eigenheads and of the smooth deformations in ``gaussian_process``; this is the search of the paper's section 3.2 with a
scale and without landmarks. Distances are measured from model to mesh, so the mesh's other parts, such as shoulders,
have no effect."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from pipeline.applications.templates.placement import Surface, samples
from pipeline.geometry.registration.rigid import motion_about, motion_columns, solve_with_prior
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.gaussian_process import with_kernel
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import vertex_areas
from rig.geometry import Similarity
from rig.mesh import vertex_normals


@dataclass(frozen=True, slots=True)
class Stage:
    """Holds the limits that apply to several consecutive steps of the search (lengths in mm)."""

    steps: int
    modes: int | None  # the first ones; None: all, the smooth deformations too
    reach_mm: float  # a point of the mesh farther than this is another part
    normal_mm: float  # a right angle between normals counts as much as this many mm; 0: the nearest point of the mesh
    plane_mm: float  # residual that weighs as much as a standard deviation of a mode, per cm2


# Normals lead while the shape is millimetres off, or lids and lips meet their neighbours; then nearness decides.
STAGES = (
    Stage(5, 10, 25.0, 12.0, 2.0),
    Stage(5, 40, 15.0, 12.0, 1.0),
    Stage(6, None, 10.0, 12.0, 0.4),
    Stage(10, None, 5.0, 0.0, 0.05),
)
FACING = 0.6  # cosine between normals of matched points
ROBUST, MIN_MM = 5.0, 0.05  # scale of Geman and McClure's weight, by the median residual; and its least
MET_MM = 10.0  # points nearer at the end count as matched
MARK_MM = 0.5  # to which a landmark is marked, an axis
BULGE = 0.75  # of the way to the tangent planes at a triangle's corners, as its authors have it
CANDIDATES = 16
ROWS = 6000  # vertices of the model that are matched


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMarks:
    """Holds points on a head model's surface, each a mean of three vertices, and their positions on another mesh."""

    rows: Int[np.ndarray, "p 3"]
    weights: Float[np.ndarray, "p 3"]
    points: Float[np.ndarray, "p 3"]
    deviation_mm: Float[np.ndarray, "p 3"]  # to which each is known along x, y, z

    @classmethod
    def of_landmarks(cls, model: HeadModel, landmarks: Mapping[str, Float[np.ndarray, " 3"]]) -> "SurfaceMarks":
        """Returns marks for a person's landmarks; landmarks that the head model lacks are ignored."""
        known = {model.landmarks[name]: point for name, point in landmarks.items() if name in model.landmarks}
        rows = np.repeat(np.array(list(known), int)[:, None], 3, axis=1)
        return cls(
            rows,
            np.full(rows.shape, 1.0 / 3.0),
            np.array([*known.values(), np.zeros(3)])[:-1],
            np.full(rows.shape, MARK_MM),
        )

    def on(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "p 3"]:
        """Returns the marks' positions on a head with the given vertices."""
        return np.einsum("pk,pkx->px", self.weights, vertices[self.rows])


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """Holds the head model fitted to a mesh, and the distances that remain between them."""

    vertices: Float[np.ndarray, "v 3"]  # of the full level, in the frame that the search began in
    distances: Float[np.ndarray, " s"]  # mm, of some vertices of the model from the mesh; inf where nothing was met
    areas: Float[np.ndarray, " s"]  # that these vertices stand for, mm2
    in_face: Bool[np.ndarray, " s"]  # which of them lie in the face region
    deviation: float  # root mean square of the eigenheads' coefficients, standard deviations


def fit_model_to_mesh(
    model: HeadModel, mesh: Surface, marks: SurfaceMarks | None = None, stages: Sequence[Stage] = STAGES
) -> Likeness:
    """Fits a head model's shape and pose to a mesh and to marks on that mesh. The mesh must already lie approximately
    at the mean head's position."""
    wide = with_kernel(model, len(model.modes))
    full, count = model.levels["full"], len(model.modes)
    marks = marks or SurfaceMarks.of_landmarks(model, {})
    rows = np.arange(0, len(model.mean), max(1, len(model.mean) // ROWS))  # of the cage: even over the surface
    modes = np.concatenate([_modes_at(wide, rows), np.repeat(_modes_on(wide, marks), 3, axis=0)])
    areas = vertex_areas(model.vertices(np.zeros(0)), full.faces)[rows]
    areas *= vertex_areas(model.vertices(np.zeros(0)), full.faces).sum() / areas.sum()
    target, z, place = MetSurface(mesh), np.zeros(len(wide.modes)), Similarity.identity()
    for stage in stages:
        active = min(count, stage.modes) if stage.modes else len(z)
        for _ in range(stage.steps):
            head = place.apply(wide.vertices(z))
            normals = vertex_normals(head, full.faces)[rows]
            met, planes, _, weight = target.meet(head[rows], normals, stage)
            known = marks.deviation_mm.ravel() ** -2
            information = np.concatenate([weight * areas / 100.0 / stage.plane_mm**2, known])
            points = np.concatenate([head[rows], np.repeat(marks.on(head), 3, axis=0)])
            met = np.concatenate([met, np.repeat(marks.points, 3, axis=0)])
            planes = np.concatenate([planes, np.tile(np.eye(3), (len(marks.points), 1))])  # a mark is three planes
            turned = (place.scale * planes @ place.rotation).astype(np.float32)  # n^T s R
            along = sum(turned[:, axis, None] * modes[:, axis, :active] for axis in range(3))
            centre = points.mean(axis=0)
            columns = np.concatenate([along, motion_columns(points - centre, planes, scale=True)], axis=1)
            ahead, prior = np.einsum("nx,nx->n", met - points, planes), np.repeat([1.0, 0.0], [active, 7])
            state = np.concatenate([z[:active], np.zeros(7)])
            step = solve_with_prior(columns, ahead, information, prior, state, precision=np.float32, ridge=1e-6)
            step[-1] = np.clip(step[-1], -0.1, 0.1)
            z[:active] += step[:active]
            place = motion_about(centre, step[active:]) @ place
    head = place.apply(wide.vertices(z))
    normals = vertex_normals(head, full.faces)[rows]
    _, _, off, weight = target.meet(head[rows], normals, replace(STAGES[-1], reach_mm=MET_MM))
    deviation = float(np.sqrt(np.mean(z[:count] ** 2)))
    return Likeness(head, np.where(weight > 0, off, np.inf), areas, full.face_region[rows], deviation)


def _modes_at(model: HeadModel, rows: Int[np.ndarray, " r"]) -> Float[np.ndarray, "r 3 m"]:
    return np.ascontiguousarray(model.basis("full", len(model.modes), rows).transpose(1, 2, 0))


def _modes_on(model: HeadModel, marks: SurfaceMarks) -> Float[np.ndarray, "p 3 m"]:
    if not len(marks.rows):
        return np.zeros((0, 3, len(model.modes)), np.float32)
    at = _modes_at(model, marks.rows.ravel()).reshape(*marks.rows.shape, 3, len(model.modes))
    return np.einsum("pk,pkxm->pxm", marks.weights.astype(np.float32), at, optimize=True)


class MetSurface:
    """Holds the mesh to which the head model is fitted, with search trees by position and by position with normal."""

    def __init__(self, mesh: Surface) -> None:
        self._mesh, self._surface = mesh, SurfaceIndex(mesh.vertices, mesh.faces)
        self._places, self._normals = samples(mesh)
        self._trees: dict[float, KDTree] = {}

    def meet(
        self, points: Float[np.ndarray, "s 3"], normals: Float[np.ndarray, "s 3"], stage: Stage
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns, for each point, its closest point on the mesh, the normal there, the distance, and a weight."""
        places, planes = self._nearest(points, normals, stage.normal_mm)
        apart = places - points
        off = np.linalg.norm(apart, axis=1)
        met = (off < stage.reach_mm) & (np.einsum("nx,nx->n", normals, planes) > FACING)
        if not stage.normal_mm:
            along = np.einsum("nx,nx->n", apart, planes)
            met &= np.sqrt(np.maximum(off**2 - along**2, 0.0)) < np.maximum(1.0, 0.5 * off)
        usual = float(np.median(off[met])) if met.any() else stage.reach_mm
        robust = np.clip(ROBUST * usual, MIN_MM, 0.5 * stage.reach_mm)
        return places, planes, off, met / (1.0 + (off / robust) ** 2) ** 2

    def _nearest(
        self, points: Float[np.ndarray, "s 3"], normals: Float[np.ndarray, "s 3"], normal_mm: float
    ) -> tuple[np.ndarray, np.ndarray]:
        if normal_mm:
            if normal_mm not in self._trees:
                self._trees[normal_mm] = KDTree(np.concatenate([self._places, normal_mm * self._normals], axis=1))
            query = np.concatenate([points, normal_mm * normals], axis=1)
            row = np.asarray(self._trees[normal_mm].query(query)[1], int)
            return self._places[row], self._normals[row]
        hits = self._surface.closest(points, CANDIDATES, facing=normals)
        rows = self._mesh.faces[hits.triangles]
        corners, normals = self._mesh.vertices[rows], self._mesh.normals[rows]
        # Phong tessellation (Boubekeur and Alexa 2008): vertices of a coarse mesh lie on the skin, its triangles within
        above = np.einsum("nkx,nkx->nk", hits.points[:, None] - corners, normals)
        bulge = np.einsum("nk,nk,nkx->nx", hits.weights, above, normals)
        planes = np.einsum("nk,nkx->nx", hits.weights, normals)
        planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-12)
        return hits.points - BULGE * bulge, planes
