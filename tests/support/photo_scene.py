"""A head-sized ellipsoid as a model, and photographs of a bumped one, drawn by the compiled z-buffer."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.contour_fit.contour import ContourSolution
from pipeline.contour_fit.problem import Stage, State, first_evidence, make_problem
from pipeline.geometry.projection import camera_depths
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.head_model.gaussian_process import with_kernel
from pipeline.head_model.model import HeadModel, assemble
from pipeline.head_model.model_file import ModelParts
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.settings import FittingSettings
from rig.geometry import Similarity
from rig.mesh import Mesh, vertex_normals
from rig.rig import Rig
from tests.support.scenes import ellipsoid, fan

Colours = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of points and normals: grey, 0 to 1


def ellipsoid_model(subdivisions: int = 4) -> HeadModel:
    """2,562 vertices; the front half is the face. One mode, a hair's breadth of size, and the kernel's."""
    mesh = ellipsoid(subdivisions)
    rows = np.arange(len(mesh.vertices))
    chin = int(np.argmin(mesh.vertices[:, 1] - mesh.vertices[:, 2]))
    parts = ModelParts(
        name="ellipsoid",
        licence="CC0",
        source="closed form",
        notice="",
        subjects={"total": 1, "male": 0, "female": 0},
        mean=mesh.vertices,
        modes=mesh.vertices[None] * 1e-3,
        sigma=np.array([1.0]),
        landmarks={"gnathion": chin},
        faces=mesh.faces,
        face_region=mesh.vertices[:, 2] > 10.0,
        subdivisions=1,
        decimated={"p95": (rows, mesh.faces), "p99": (rows, mesh.faces)},
    )
    return with_kernel(assemble(parts, ""), 1, most=80)


def bumped(model: HeadModel, height_mm: float, width_mm: float = 14.0) -> np.ndarray:
    """Vertices of the full level, raised along the normals around the foremost point."""
    vertices = model.vertices(np.zeros(0))
    top = vertices[np.argmax(vertices[:, 2])]
    rise = height_mm * np.exp(-0.5 * ((vertices - top) ** 2).sum(axis=1) / width_mm**2)
    return vertices + rise[:, None] * vertex_normals(vertices, model.levels["full"].faces)


def texture(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Waves of 12 to 30 mm in all directions, on a shaded ground."""
    waves = sum(np.sin(points @ np.array(k)) for k in ([0.5, 0.1, 0.1], [-0.1, 0.4, 0.2], [0.2, -0.2, 0.3]))
    return 0.5 + 0.08 * waves * (0.4 + 0.6 * normals[:, 2].clip(0, 1))


def fine_waves(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Waves of 5 to 9 mm in all directions: a pixel is 0.9 mm."""
    waves = np.sin(points @ np.array([[1.2, 0.2, 0.2], [-0.2, 0.8, 0.4], [0.6, -0.5, 0.5]]).T)
    return 0.5 + 0.1 * waves.sum(axis=1)


def glossy(eye: np.ndarray) -> Colours:
    """A faint texture under a highlight as a camera at ``eye`` sees it."""
    halfway = eye / np.linalg.norm(eye) + np.array([0.3, 0.4, 0.87])
    halfway /= np.linalg.norm(halfway)

    def colours(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        off = np.degrees(np.arccos(np.clip(normals @ halfway, -1.0, 1.0)))
        return 0.37 + 0.06 * fine_waves(points, normals) + 0.3 * np.exp(-0.5 * (off / 10.0) ** 2)

    return colours


def shading(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """A bare Lambertian surface under two lamps."""
    lamps = np.array([[0.5, 0.6, 0.62], [-0.6, 0.2, 0.77]])
    return 0.2 + 0.35 * (normals @ lamps.T).clip(0, 1).sum(axis=1)


@dataclass(frozen=True)
class Scene:
    model: HeadModel
    rig: Rig
    truth: np.ndarray  # vertices of the full level
    images: dict[str, np.ndarray]
    silhouettes: dict[str, Silhouette]

    def start(self) -> ContourSolution:
        """The mean head in its true place, as a fit to contours that miss the bump would leave it."""
        problem = make_problem(self.model, Similarity.identity(), self.silhouettes, self.rig, FittingSettings(), {})
        modes = len(self.model.modes)
        state = State(np.zeros(modes), Similarity.identity(), np.zeros((len(self.rig), 6)))
        evidence = first_evidence(FittingSettings())
        return ContourSolution(
            problem, evidence, state, Stage("p95", modes, True, (1.5,), False, True, 3), 0, "planted"
        )

    def error(self, solved: ContourSolution) -> np.ndarray:
        """Along the true normals, of the whole face region."""
        found = solved.state.world_from_head.apply(solved.problem.model.vertices(solved.state.coefficients))
        level = self.model.levels["full"]
        normals = vertex_normals(self.truth, level.faces)
        return ((found - self.truth) * normals).sum(axis=1)[level.face_region]


def photograph(
    model: HeadModel,
    vertices: np.ndarray,
    colours: Colours,
    *,
    noise: float = 0.015,
    gains: np.ndarray | None = None,
    rig: Rig | None = None,
    true_rig: Rig | None = None,
    seed: int = 3,
) -> Scene:
    """``true_rig`` takes the pictures where it differs from ``rig``, a fan of ten by default."""
    rig, rng = rig or fan(640, 480), np.random.default_rng(seed)
    faces = model.levels["full"].faces
    fine = Mesh(vertices, faces)
    grey = colours(vertices, fine.normals())
    gains = np.ones(len(rig)) if gains is None else gains
    images, silhouettes = {}, {}
    for camera, gain in zip(true_rig or rig, gains, strict=True):
        pixels, depths = camera.project(vertices), camera_depths(camera, vertices)
        _, seen = rasterise(pixels, depths, faces, camera.intrinsics.height, camera.intrinsics.width)
        drawn = interpolate(seen, pixels, depths, faces, grey[:, None].astype(np.float32))[:, :, 0]
        light = cv2.GaussianBlur(np.nan_to_num(drawn, nan=0.1), (0, 0), 0.7)
        codes = gain * light + rng.normal(0.0, noise, light.shape)
        images[camera.name] = np.repeat(np.rint(255 * codes).clip(0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
        silhouettes[camera.name] = silhouette_from_mask(seen >= 0)
    return Scene(model, rig, vertices, images, silhouettes)
