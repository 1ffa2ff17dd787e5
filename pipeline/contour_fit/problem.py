"""Defines the contour solver's data types: its state, its stages, and everything that stays fixed during a fit."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int

from pipeline.contour_fit.rim import Topology, Views, make_topology, pack_views
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from rig.camera import Camera
from rig.geometry import Similarity, rotation_from_vector
from rig.rig import Rig

POSE = 7  # rotation, translation, log scale
PER_CAMERA = 6  # rotation, translation
FIRST_NOISE_PX, FIRST_CORRELATION_PX = 1.0, 6.0  # before the residuals have been seen: a model that does not quite fit


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Holds the current estimate of the solver: coefficients (in standard deviations), pose of the head, and the
    correction of each camera (rotation in rad, then translation in mm)."""

    coefficients: Float[np.ndarray, " m"]
    world_from_head: Similarity
    camera_shift: Float[np.ndarray, "k 6"]  # left perturbation of each camera_from_world


@dataclass(frozen=True, slots=True)
class Stage:
    """Holds one stage of the coarse-to-fine fit: which unknowns it solves for, at which mesh resolution, and which part
    of the outline counts."""

    level: str
    modes: int
    cameras: bool  # are the cameras solved for as well?
    scales_px: tuple[float, ...]  # robust scale, step by step
    whole_head: bool  # do rims outside the face region count?
    contained: bool  # do they at least count where they stick out of the input, as no hair explains?
    steps: int  # Levenberg-Marquardt steps at most, at each scale


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Holds feature points as arrays with one row for each: the landmark's vertex on the full mesh, the view, the
    observed pixel, and the model's mean and modes at the vertex (head frame, mm)."""

    vertex: Int[np.ndarray, " n"]
    view: Int[np.ndarray, " n"]
    pixel: Float[np.ndarray, "n 2"]
    mean: Float[np.ndarray, "n 3"]
    basis: Float32[np.ndarray, "m n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkObservations:
    """Holds triangulated landmarks of the face in arrays with one row for each.

    Attributes:
        corner: three vertices of the full mesh around each landmark.
        blend: their weights, which sum to 1.
        position_world: triangulated positions, mm.
        whiten: turns the differences of all coordinates (mm), stacked, into uncorrelated standard deviations.
        mean: the mean head at the landmarks, head frame, mm.
        basis: the model's modes at the landmarks, head frame, mm per standard deviation.
    """

    corner: Int[np.ndarray, "n 3"]
    blend: Float[np.ndarray, "n 3"]
    position_world: Float[np.ndarray, "n 3"]
    whiten: Float[np.ndarray, "p p"]
    mean: Float[np.ndarray, "n 3"]
    basis: Float32[np.ndarray, "m n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class LevelBasis:
    """Holds the mean and modes (head frame, mm) of a mesh level, and the sparse operator that turns them into the
    level's vertices.

    A decimated mesh stores its modes at its own vertices (2 MB), and its operator is the identity. The full mesh stores
    its modes at the vertices of a coarse mesh (the cage), since modes at all its vertices would take 40 to 170 MB.
    """

    operator: sparse.csr_array
    mean: Float[np.ndarray, "v 3"]
    modes: Float32[np.ndarray, "v 3 m"]

    def vertices(self, coefficients: Float[np.ndarray, " n"]) -> Float[np.ndarray, "V 3"]:
        """Returns the level's vertices (head frame, mm); missing coefficients at the end of the vector count as 0. The
        sum over modes is in single precision, exact to 1e-5 mm, for speed."""
        flat = self.modes.reshape(self.mean.size, -1)
        moved = flat[:, : len(coefficients)] @ coefficients.astype(np.float32)
        return self.operator @ (self.mean + moved.reshape(-1, 3))


@dataclass(frozen=True, slots=True, eq=False)
class ContourProblem:
    """Holds everything that stays fixed while the solver runs: model, cameras, silhouettes, feature points, landmarks
    and settings."""

    model: HeadModel
    rig: Rig
    views: Views
    bases: Mapping[str, LevelBasis]  # by level
    topologies: Mapping[str, Topology]
    camera_information: Float[np.ndarray, "k 6 6"]  # inverse prior covariance
    features: Observed | None
    settings: FittingSettings
    landmarks: LandmarkObservations | None = None
    held: frozenset[int] = frozenset()  # expressions, by their place among the model's, whose weights stay 0


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceObservations:
    """Holds n point-to-plane observations. Each observation states how far a vertex of the full mesh should move along
    a normal. ``surface_term`` has the equation. The k cameras are in the order of the solver's views; c = 6 k."""

    vertex: Int[np.ndarray, " n"]
    basis: Float32[np.ndarray, "m n 3"]  # the model's modes at those vertices, head frame
    mean: Float[np.ndarray, "n 3"]  # the mean head there
    normal: Float[np.ndarray, "n 3"]  # world, unit
    seen_at: Float[np.ndarray, "n 3"]  # world, mm: where the vertex stood
    displacement: Float[np.ndarray, " n"]  # mm along the normal
    information: Float[np.ndarray, " n"]  # mm^-2
    bound: Bool[np.ndarray, " n"]  # hair: the head lies there or anywhere inside
    by_camera: Float[np.ndarray, "n c"]  # c = 6 K
    camera_shift: Float[np.ndarray, "k 6"]  # when observed
    camera_matrix: Float[np.ndarray, "c c"]
    camera_gradient: Float[np.ndarray, " c"]


@dataclass(frozen=True, slots=True, eq=False)
class RimNoise:
    """Holds the noise of the outlines, which determines the weights of the rim samples.

    Attributes:
        unit: l sigma^2 (px^3) of an outline with noise sigma and correlation length l. The cost is squared residual
            (px^2) times outline length (px), divided by it.
        floor_px: the smallest scale of the robust loss: three standard deviations of the model's misfit.
        clutter: for each view, the cells with hair or clothes; None before the search for them.
        is_settled: whether ``clutter`` comes from a fit rather than from the start pose.
        bare: for each view, the cells near the outline of a bald head; None before the search for them.
    """

    unit: float
    floor_px: float
    clutter: tuple[Bool[np.ndarray, "_ _"], ...] | None
    is_settled: bool = False
    bare: tuple[Bool[np.ndarray, "_ _"], ...] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PhotoEvidence:
    """Holds the surface observations from photographs, and for each mesh level which vertices lie under hair."""

    surface: SurfaceObservations
    hair: Mapping[str, Bool[np.ndarray, " v"]]


@dataclass(frozen=True, slots=True, eq=False)
class StageEvidence:
    """Holds the results of earlier stages: the noise of the outlines and, if measured, surface observations from
    photographs."""

    noise: RimNoise
    photographs: PhotoEvidence | None = None


def first_evidence(settings: FittingSettings) -> StageEvidence:
    """Returns the evidence for the first stage: the outlines' noise from the settings, or a default."""
    noise, length = settings.contour_noise_px or FIRST_NOISE_PX, settings.contour_correlation_px
    return StageEvidence(RimNoise(noise**2 * (length or FIRST_CORRELATION_PX), 0.0, None))


def make_problem(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    features: Mapping[str, Mapping[str, np.ndarray]],
    *,
    levels: tuple[str, ...] = ("p95", "full"),
    landmarks: LandmarkObservations | None = None,
) -> ContourProblem:
    """Packs everything that stays fixed during a fit. ``features`` are feature points (px) by camera and landmark name.
    Raises ValueError if no silhouette is usable."""
    usable = {name: s.distance for name, s in silhouettes.items() if s.quality.usable and name in rig}
    views = pack_views(rig, usable)
    rig = rig.subset(views.names)
    topologies = {name: level_topology(model, name) for name in levels}
    depths = [camera.camera_from_world.apply(world_from_head.translation)[2] for camera in rig]
    information = [camera_information(c, z, settings.calibration_px) for c, z in zip(rig, depths, strict=True)]
    return ContourProblem(
        model=model,
        rig=rig,
        views=views,
        bases={name: level_basis(model, name) for name in levels},
        topologies=topologies,
        camera_information=np.stack(information),
        features=pack_features(model, views.names, features),
        settings=settings,
        landmarks=landmarks,
    )


@lru_cache(maxsize=4)  # models are few, jobs are many
def level_basis(model: HeadModel, name: str) -> LevelBasis:
    """Returns the mean and modes (head frame, mm) of a mesh level. Mean and modes are stored at the level's vertices or
    at those of the coarse cage mesh, whichever are fewer."""
    level = model.levels[name]
    if level.count < len(model.mean):
        coarse_basis = model.basis(name, len(model.modes)).transpose(1, 2, 0)
        same = sparse.csr_array(sparse.identity(level.count, format="csr"))
        return LevelBasis(same, model.vertices(np.zeros(0), name), np.ascontiguousarray(coarse_basis))
    return LevelBasis(level.operator, model.mean.astype(float), np.ascontiguousarray(model.modes.transpose(1, 2, 0)))


@lru_cache(maxsize=4)
def level_topology(model: HeadModel, name: str) -> Topology:
    """Returns a mesh level's edges and regions. Faces of the neck below the chin belong to no region, because the head
    turns on the neck, collars hide it, and no real neck ends at the model's lower border."""
    level = model.levels[name]
    mean = model.vertices(np.zeros(0), name)
    chin = model.vertices(np.zeros(0))[model.landmarks["gnathion"], 1]
    return make_topology(level.faces, level.face_region, mean[:, 1] > chin)


def camera_information(camera: Camera, depth_mm: float, error_px: float) -> Float[np.ndarray, "6 6"]:
    """Returns the inverse prior covariance of a camera's correction (rad, mm). The covariance follows from the camera's
    calibrated covariance or, if there is none, from an error of ``error_px`` in the image.

    The default prior moves the image of a head of 100 mm radius at ``depth_mm`` by ``error_px`` RMS. Half of the
    variance is due to rotation and half to translation, because both shift the image of a head alike.
    """
    if camera.covariance is not None:
        return np.linalg.inv(camera.covariance + 1e-12 * np.eye(6))
    focal, radius = camera.intrinsics.fx, 100.0
    shift = error_px / np.sqrt(2.0)
    tilt, roll = shift / focal, error_px * depth_mm / (focal * radius)
    slide, range_mm = shift * depth_mm / focal, error_px * depth_mm**2 / (focal * radius)
    return np.diag(1.0 / np.array([tilt, tilt, roll, slide, slide, range_mm]) ** 2)


def pack_features(
    model: HeadModel, names: tuple[str, ...], features: Mapping[str, Mapping[str, np.ndarray]]
) -> Observed | None:
    """Packs the feature points (px) that belong to the model's landmarks into arrays. Returns None without feature
    points."""
    found = [
        (model.landmarks[landmark], names.index(camera), pixel)
        for landmark, views in sorted(features.items())
        if landmark in model.landmarks
        for camera, pixel in sorted(views.items())
        if camera in names
    ]
    if not found:
        return None
    vertex, view, pixel = (np.array(column) for column in zip(*found, strict=True))
    return Observed(vertex, view, pixel.astype(float), *landmark_basis(model, vertex))


def landmark_basis(
    model: HeadModel, vertex: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Float32[np.ndarray, "m n 3"]]:
    """Returns the mean (n 3) and all modes (m n 3) of the model at vertices of the full mesh, head frame, mm."""
    mean = np.asarray(model.levels["full"].operator[vertex] @ model.mean, float)
    return mean, model.basis("full", len(model.modes), vertex)


def blended_basis(
    model: HeadModel, corner: Int[np.ndarray, "n 3"], blend: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float32[np.ndarray, "m n 3"]]:
    """Returns the model's mean and all its modes (head frame, mm) at points inside triangles of the full mesh. A point
    is the mean of the three vertices ``corner`` with weights ``blend``."""
    rows, inverse = np.unique(corner, return_inverse=True)
    mean, basis = landmark_basis(model, rows)
    at = inverse.reshape(corner.shape)
    blended = np.einsum("mnkc,nk->mnc", basis[:, at], blend.astype(np.float32), optimize=True)
    return (mean[at] * blend[:, :, None]).sum(axis=1), blended


def widen(problem: ContourProblem, model: HeadModel, levels: tuple[str, ...]) -> ContourProblem:
    """Returns the problem for another head ``model`` with the same mesh and more modes. Keeps only the mesh resolutions
    named in ``levels``."""
    features = problem.features
    if features is not None:
        mean, basis = landmark_basis(model, features.vertex)
        features = replace(features, mean=mean, basis=basis)
    landmarks = problem.landmarks
    if landmarks is not None:
        mean, basis = blended_basis(model, landmarks.corner, landmarks.blend)
        landmarks = replace(landmarks, mean=mean, basis=basis)
    bases = {name: level_basis(model, name) for name in levels}
    return replace(problem, model=model, bases=bases, features=features, landmarks=landmarks)


def start_state(problem: ContourProblem, world_from_head: Similarity) -> State:
    """Returns the state at which a fit starts: the mean head at the given pose, and every camera as calibrated."""
    return State(np.zeros(0), world_from_head, np.zeros((len(problem.views.names), PER_CAMERA)))


def moved_views(problem: ContourProblem, state: State) -> Views:
    """Returns the problem's views with the state's corrections applied to their cameras."""
    if not state.camera_shift.any():
        return problem.views
    turn = rotation_from_vector(state.camera_shift[:, :3])
    rotation = turn @ problem.views.rotation
    translation = (turn @ problem.views.translation[:, :, None])[:, :, 0] + state.camera_shift[:, 3:]
    return replace(problem.views, rotation=rotation, translation=translation)
