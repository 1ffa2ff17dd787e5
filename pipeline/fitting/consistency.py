"""Photo-consistency: where along its normal each patch of the surface looks alike in the views that see it.

The variance of a place is that of a shift between two signals of correlation rho,

    variance = floor^2 + noise area / window area * (1 - rho) / |d^2 rho / d shift^2|,

so that texture, noise, defocus and grazing views all show in it. Gain and offset of a camera drop out.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.fitting.contour import Problem, State, moved_views
from pipeline.fitting.hairline import Sight, under_hair
from pipeline.fitting.patches import Patches
from pipeline.fitting.photographs import LEAST_BLUR_PX, Photographs, blurred, distance_of
from pipeline.fitting.registration import gather, register
from pipeline.fitting.rim import Views
from pipeline.fitting.surface import SurfaceObservations
from pipeline.fitting.sweep import correlate, facing_of, project_all, sweep
from pipeline.settings import PhotoSettings
from pipeline.zbuffer import rasterise
from rig.mesh import vertex_normals


@dataclass(frozen=True, slots=True)
class Round:
    """One pass over all patches."""

    window_mm: float  # standard deviation of the patch's window
    blur_mm: float  # of the images, on the head
    reach_mm: float  # to both sides along the normal
    steps: int


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """The head as it stands, and who sees what of it."""

    views: Views  # with the cameras where the state has them
    vertices: Float[np.ndarray, "v 3"]  # full level, world
    normals: Float[np.ndarray, "v 3"]
    points: Float[np.ndarray, "s 3"]  # samples
    outward: Float[np.ndarray, "s 3"]  # their normals
    facing: Float32[np.ndarray, "k s"]  # cosine between normal and line of sight, 0 where a camera does not see it
    covered: tuple[Bool[np.ndarray, "h w"], ...]  # where each camera sees the head


def look(
    problem: Problem, state: State, patches: Patches, speaks: Bool[np.ndarray, " k"], settings: PhotoSettings
) -> Looks:
    """Draws the depth of the head in every view, and asks for every sample."""
    faces = problem.model.levels["full"].faces
    vertices = state.world_from_head.apply(problem.model.vertices(state.coefficients))
    normals = vertex_normals(vertices, faces)
    points, outward = patches.points(vertices), patches.normals(normals)
    views = moved_views(problem, state)

    def one(k: int) -> tuple[np.ndarray, np.ndarray]:
        width, height = views.size[k]
        if not speaks[k]:
            return np.zeros(len(points), np.float32), np.zeros((height, width), bool)
        pixels, depths = project_all(vertices, views.rotation[k], views.translation[k], views.lens[k])
        pixels[pixels[:, 0] > 1e8] = np.nan
        depth, _ = rasterise(pixels, depths, faces, int(height), int(width))
        seen = facing_of(
            points, outward, views.rotation[k], views.translation[k], views.lens[k], depth, distance_of(views, k),
            settings.hidden_mm, settings.contour_margin_px,
        )  # fmt: skip
        return seen, np.isfinite(depth)

    with ThreadPoolExecutor() as pool:
        facing, covered = zip(*pool.map(one, range(len(views.names))), strict=True)
    return Looks(views, vertices, normals, points, outward, np.stack(facing), covered)


def hair_patches(
    problem: Problem, state: State, patches: Patches, photographs: Photographs, looks: Looks
) -> Bool[np.ndarray, " c"]:
    """The patches that lie under hair, by its colour."""
    views, model = looks.views, problem.model
    chin = looks.vertices[model.landmarks["gnathion"]]
    ends = np.stack([chin, chin + 10.0 * state.world_from_head.rotation[:, 1]])
    sights = []
    for k in np.flatnonzero(photographs.speaks).tolist():
        pixels, _ = project_all(looks.points, views.rotation[k], views.translation[k], views.lens[k])
        (low, high), _ = project_all(ends, views.rotation[k], views.translation[k], views.lens[k])
        sights.append(
            Sight(
                photographs.colour[k], looks.covered[k], distance_of(views, k), pixels, looks.facing[k] > 0, low,
                high - low,
            )
        )  # fmt: skip
    return under_hair(model, patches, sights)


def observe(
    problem: Problem,
    state: State,
    photographs: Photographs,
    patches: Patches,
    looks: Looks,
    hair: Bool[np.ndarray, " c"],
    each: Round,
    settings: PhotoSettings,
) -> tuple[SurfaceObservations, Int[np.ndarray, " u"]]:
    """Where the photographs see the surface, by the vertices at the patches' centres; a patch of ``hair`` says
    only that the head is no farther out than that."""
    views, points, outward, facing = looks.views, looks.points, looks.outward, looks.facing
    steps = np.linspace(-each.reach_mm, each.reach_mm, each.steps)
    scale = pixels_per_mm(views, state.world_from_head.translation)
    image, noise = blurred(photographs, each.blur_mm * scale)
    grey = sweep(
        points, outward, facing, views.rotation, views.translation, views.lens, views.size, views.offset, image, steps
    )  # fmt: skip
    weights = patches.weights(each.window_mm)
    score, used = correlate(
        patches.start, patches.member, weights, facing, grey, noise,
        settings.least_seen, settings.views_most,
    )  # fmt: skip
    found = find_peaks(score, steps)
    blur_mm = np.maximum(each.blur_mm, LEAST_BLUR_PX / scale).mean()
    variance = settings.floor_mm**2 + (blur_mm / each.window_mm) ** 2 * (1.0 - found.height) / found.curvature
    bounded = ~hair | ((found.place < 0.0) & (found.height > 0.9))
    kept = np.flatnonzero(bounded & (used >= 2) & found.inside & (found.height > settings.least_correlation))
    # Patches overlap: what they say together is worth their area, not their number.
    overlap = max(1.0, 4.0 * np.pi * each.window_mm**2 / settings.centre_mm**2)
    information = 1.0 / (overlap * variance[kept])
    rows, level = patches.centre[kept], problem.model.levels["full"]
    by_view = register(
        kept, patches.start, patches.member, weights, facing, points, outward, looks.vertices[rows],
        looks.normals[rows], found.place[kept], views.rotation, views.translation, views.lens, views.size,
        views.offset, image, noise, settings.least_seen, settings.views_most,
    )  # fmt: skip
    places = looks.vertices[rows] + found.place[kept, None] * looks.normals[rows]
    by_camera, camera_matrix, camera_gradient = gather(
        *by_view, information, places, views.rotation, views.translation, views.lens
    )
    metric = metric_rig(views, state.world_from_head.translation, settings.rig_scale_spread)
    seen = SurfaceObservations(
        vertex=rows,
        basis=problem.model.basis("full", len(problem.model.modes), rows),
        mean=level.operator[rows] @ problem.model.mean.astype(float),
        normal=looks.normals[rows],
        seen_at=looks.vertices[rows],
        displacement=found.place[kept],
        information=information,
        by_camera=by_camera,
        camera_shift=state.camera_shift,
        camera_matrix=camera_matrix + metric,
        camera_gradient=camera_gradient - metric @ state.camera_shift.ravel(),
    )
    lost = ~hair & (used >= 2) & ~(found.inside & (found.height > settings.least_correlation))
    return seen, patches.centre[lost]


def metric_rig(views: Views, at_world: Float[np.ndarray, " 3"], spread: float) -> Float[np.ndarray, "c c"]:
    """Information that cameras do not all err towards the head alike: their distances come from one board, whose size
    is known. Images alone cannot tell; a contour that lies a tenth of a pixel too far out would otherwise move every
    camera closer, and the surface with them."""
    depth = views.rotation[:, 2] @ at_world + views.translation[:, 2]
    nearer = np.zeros((len(depth), 6))
    nearer[:, 5] = 1.0 / (len(depth) * depth)
    return np.outer(nearer, nearer) / spread**2


def pixels_per_mm(views: Views, at_world: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " k"]:
    """How large each camera sees a mm at the head's place."""
    depth = views.rotation[:, 2] @ at_world + views.translation[:, 2]
    return views.lens[:, 0] / depth


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """The highest point of each patch's correlation."""

    place: Float[np.ndarray, " c"]  # mm along the normal
    height: Float[np.ndarray, " c"]
    curvature: Float[np.ndarray, " c"]  # mm^-2
    inside: np.ndarray  # is it a peak, and not the end of the reach?


def find_peaks(score: Float32[np.ndarray, "c d"], steps: Float[np.ndarray, " d"]) -> Peaks:
    """Through the parabola of the highest step and its neighbours."""
    best = score.argmax(axis=1)
    middle = np.clip(best, 1, len(steps) - 2)
    rows, step = np.arange(len(score)), steps[1] - steps[0]
    below, at, above = (score[rows, middle + j].astype(float) for j in (-1, 0, 1))
    bend = np.maximum(2.0 * at - below - above, 1e-6)
    offset = np.clip(0.5 * (above - below) / bend, -1.0, 1.0)
    return Peaks(
        place=steps[middle] + offset * step,
        height=np.minimum(at + 0.25 * (above - below) * offset, 1.0),
        curvature=bend / step**2,
        inside=best == middle,
    )
