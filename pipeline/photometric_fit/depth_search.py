"""Finds, for each patch of the surface, the position along its normal at which the patch looks most alike in its views
(photo-consistency).

The variance of this position is that of a shift between two signals with correlation rho:

    variance = floor^2 + noise area / window area * (1 - rho) / |d^2 rho / d shift^2|.

The variance therefore depends on texture, noise, defocus and oblique views. Gain and offset of a camera have no effect
on the correlation.

The same patches also determine by how much the image of each view should shift. Where a patch's views correlate best,
the negative mean correlation equals, up to constants, the least-squares cost ``sum_k v_k |f_k - T|^2``. In this cost
f_k are the patch's grey values in view k, centred and of unit norm, v_k is the view's weight, and T is the weighted
mean of all f_k. Taking T as the mean eliminates the unknown texture exactly, and also any sliding along the surface.
Linearised in the image shifts delta_k (px) of the views, this cost has the second derivatives H and the gradient

    H_kl = v_k [k = l] <g_k, g_k> - v_k v_l / V <g_k, g_l>,   gradient_k = v_k <g_k, f_k - T>.

In these formulas g_k are the image derivatives and V is the sum of the weights. A displacement u along the normal and
camera corrections c_k cause the image shifts ``delta_k = p_k u + C_k c_k``. Eliminating u leaves two results: the
derivative of the patch's depth by the cameras' poses, and a quadratic form in the camera corrections alone, for image
shifts that no surface explains. Thousands of patches together reveal a camera error of 0.2 px."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.compute.threads import in_threads, map_in_threads
from pipeline.contour_fit.problem import ContourProblem, State, SurfaceObservations, moved_views
from pipeline.contour_fit.rim import Views
from pipeline.geometry.projection import camera_depths, packed_camera, project_points
from pipeline.geometry.projection_kernels import rasterise
from pipeline.geometry.surface_index import facing_cosine
from pipeline.multiview.triangulation import depth_factor, parallax
from pipeline.photometric_fit.images import MIN_BLUR_PX, Photographs, blur_images
from pipeline.photometric_fit.patch_kernels import (
    Members,
    Pictures,
    Samples,
    add_by_camera,
    add_cameras,
    correlate_views,
    sweep_pictures,
    write_grams,
    write_image_motion,
)
from pipeline.photometric_fit.patches import Patches
from rig.camera import Camera
from rig.geometry import RigidTransform, second_difference, vertex_offset
from rig.mesh import Mesh

MIN_VIEW = 0.08  # least squared cosine of a view that is used: 73 degrees

CENTRE_MM = 3.0  # distance of patches
MAX_VIEWS = 5  # most frontal views between which a patch is compared
MIN_SEEN = 0.85  # of a patch's weight: a view that sees less of it does not count
MIN_CORRELATION = 0.6  # a lower peak is discarded ...
MIN_TEXTURE_CORRELATION = 0.35  # ... and without shading, where skin has 0.4 to 0.6
FLOOR_MM = 0.15  # error of an observation that no correlation shows: highlights, the patch's own relief
RIG_SCALE_SPREAD = 2e-4  # common error of all distances of a calibrated rig: 0.05 mm on a board of 250
HIDDEN_MM = 1.5  # a nearer surface hides a sample beyond this: a silhouette fit's own error
CONTOUR_MARGIN_PX = 2.0  # nothing is read nearer to the background
DEPTH_LEVEL = "p95"  # of the z-buffer: it differs from the full mesh by far less than what may hide a sample
MIN_FACING = 0.2  # cosine: at a flatter angle than 78 degrees a pixel smears over 5 times its size
EDGE_PX = 4  # nothing is read nearer to the image's edge
WINDOW_PX = 3  # around a sample in which a nearer surface may blur over it
FLATTEST = 1e-6  # curvature of correlation by a step squared: below it a peak has no place of its own
BOUND_HEIGHT = 0.9  # correlation from which on a patch of hair gives its position
SLOPE_SLACK = 1.5 * 1.414 * WINDOW_PX  # how much nearer its own slope may bring a surface within the window


@dataclass(frozen=True, slots=True)
class Round:
    """Holds the settings of one search of all patches along their normals (lengths in mm)."""

    window_mm: float  # standard deviation of the patch's window
    blur_mm: float  # of the images, on the head
    reach_mm: float  # to both sides along the normal
    steps: int
    with_shading: bool = True  # the photographs as they are; else their fine texture alone


@dataclass(frozen=True, slots=True, eq=False)
class SampleVisibility:
    """Holds the head at the current state and, for each camera, which surface samples are visible, at which pixel, and
    the cosine between normal and line of sight."""

    cameras: tuple[Camera, ...]  # where the state has them
    vertices: Float[np.ndarray, "v 3"]  # full level, world
    normals: Float[np.ndarray, "v 3"]
    points: Float[np.ndarray, "s 3"]  # samples
    facing: Float32[np.ndarray, "k s"]  # cosine between normal and line of sight, 0 where a camera does not see it
    pixel: Float[np.ndarray, "k s 2"]  # where each camera sees a sample, and how that moves along the normal, px / mm;
    along: Float[np.ndarray, "k s 2"]  # both 0 where it does not


def sample_visibility(
    problem: ContourProblem, state: State, patches: Patches, speaks: Bool[np.ndarray, " k"]
) -> SampleVisibility:
    """Finds which surface samples each camera sees on the head of ``state``, from the head's depth maps."""
    head, coarse = head_of(problem, state), head_of(problem, state, DEPTH_LEVEL)
    return visibility_of(head, coarse, moved_cameras(problem, state), problem.views, patches, speaks)


def head_of(problem: ContourProblem, state: State, level: str = "full") -> Mesh:
    """Returns the head that ``state`` describes, as the mesh ``level`` of the head model, world frame, mm."""
    laid = problem.model.levels[level]
    return Mesh(state.world_from_head.apply(laid.operator @ problem.model.cage(state.coefficients)), laid.faces)


def visibility_of(
    head_world: Mesh,
    coarse_world: Mesh,
    cameras: tuple[Camera, ...],
    views: Views,
    patches: Patches,
    speaks: Bool[np.ndarray, " k"],
) -> SampleVisibility:
    """Finds which surface samples of a head each camera sees. A coarser mesh of the same surface decides which samples
    are hidden.

    ``head_world``: the mesh that the patches belong to, mm. ``coarse_world``: the same surface with fewer triangles.
    ``cameras``: cameras of the views, at their current poses. ``views``: the silhouettes. ``patches``: the patches to
    test. ``speaks``: which views have a photograph with texture; other views are ignored.
    """
    normals = head_world.normals()
    points, outward = patches.points(head_world.vertices), patches.normals(normals)

    def one(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        camera, distance = cameras[k], views.distance_map(k)
        facing, ends = np.zeros(len(points), np.float32), np.zeros((2, len(points), 2))
        if not speaks[k]:
            return facing, ends[0], ends[1]
        pixel, depth = project_points(camera, coarse_world.vertices), camera_depths(camera, coarse_world.vertices)
        depth, _ = rasterise(pixel, depth, coarse_world.faces, *distance.shape)
        facing = facing_of(points, outward, camera, depth, distance)
        seen = np.flatnonzero(facing)
        here, further = project_points(camera, points[seen]), project_points(camera, points[seen] + outward[seen])
        ends[:, seen] = here, further - here
        return facing, ends[0], ends[1]

    facing, pixel, along = zip(*map_in_threads(one, len(cameras)), strict=True)
    return SampleVisibility(
        cameras, head_world.vertices, normals, points, np.stack(facing), np.stack(pixel), np.stack(along)
    )


def moved_cameras(problem: ContourProblem, state: State) -> tuple[Camera, ...]:
    """Returns the cameras with the pose corrections of ``state`` applied."""
    views = moved_views(problem, state)
    return tuple(
        replace(camera, camera_from_world=RigidTransform(rotation, translation))
        for camera, rotation, translation in zip(problem.rig, views.rotation, views.translation, strict=True)
    )


def facing_of(
    points: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    camera: Camera,
    depth: Float32[np.ndarray, "h w"],
    distance: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, " s"]:
    """Returns the cosine between normal and line of sight for each sample that the camera sees; 0 for hidden samples.

    ``points``: the samples, world, mm. ``normals``: unit, world. ``camera``: the camera at its current pose. ``depth``:
    z-buffer (mm) of the head in this camera. ``distance``: signed distance (px) to the silhouette.
    """
    cosine = facing_cosine(camera.centre_world, points, normals)
    height, width = depth.shape
    front = np.flatnonzero(cosine >= MIN_FACING)
    pixel = project_points(camera, points[front])
    with np.errstate(invalid="ignore"):  # NaN is outside
        inside = ((pixel >= EDGE_PX) & (pixel < (width - EDGE_PX - 1, height - EDGE_PX - 1))).all(axis=1)
    rows = front[inside]
    column, row = np.rint(pixel[inside]).astype(int).T
    nearest = cv2.erode(depth, np.ones((2 * WINDOW_PX + 1,) * 2, np.uint8))[row, column]
    z, facing = camera_depths(camera, points[rows]), cosine[rows]
    slope = np.minimum(np.sqrt(np.maximum(1.0 - facing**2, 0.0)) / facing, 4.0)
    slack = HIDDEN_MM + SLOPE_SLACK * slope * z / camera.intrinsics.fx
    seen = (distance[row, column] <= -CONTOUR_MARGIN_PX) & (z <= nearest + slack)
    out = np.zeros(len(points), np.float32)
    out[rows[seen]] = facing[seen]
    return out


def observe(
    problem: ContourProblem,
    state: State,
    photographs: Photographs,
    patches: Patches,
    visibility: SampleVisibility,
    hair: Bool[np.ndarray, " c"],
    *,
    basis: Float32[np.ndarray, "m c 3"],
    each: Round,
) -> tuple[SurfaceObservations, Int[np.ndarray, " u"]]:
    """Measures the position of the surface at the patches' centres. Returns the observations, and the centre vertices
    of patches that several cameras see but whose views do not match.

    ``problem``: problem of the contour solver. ``state``: the current head and cameras. ``photographs``: photographs of
    the views. ``patches``: the patches to measure. ``visibility``: of the patches' samples at ``state``. ``hair``:
    patches under hair, which only bound the head from outside. ``basis``: the model's modes at the patches' centres.
    ``each``: lengths of the search.
    """
    scale = pixels_per_mm(visibility.cameras, state.world_from_head.translation)
    found = find_places(photographs, patches, visibility, problem.views, scale, each=each)
    several, clear, view, value = found.several, found.clear, found.view, found.value
    kept = np.flatnonzero(several & clear & (~hair | ((found.place < 0.0) & (found.height > BOUND_HEIGHT))))
    # Patches overlap, so their information is proportional to their area, not to their number.
    overlap = max(1.0, 4.0 * np.pi * each.window_mm**2 / CENTRE_MM**2)
    information = 1.0 / (overlap * found.variance[kept])
    rows, place = patches.centre[kept], found.place[kept]
    grams = gram_matrices(
        patches, kept, found.weights, view[kept], place, samples=found.samples, pictures=found.pictures
    )
    stood, normal = visibility.vertices[rows], visibility.normals[rows]
    sensitivity = camera_sensitivity(
        view[kept], value[kept], grams, stood + place[:, None] * normal, normal, visibility.cameras
    )
    camera_matrix, camera_gradient = sensitivity.cameras(information)
    metric = metric_rig(visibility.cameras, state.world_from_head.translation)
    observations = SurfaceObservations(
        vertex=rows,
        basis=basis.take(kept, axis=1),  # basis[:, kept] is laid out by vertex, and copied whenever it is used
        mean=problem.model.levels["full"].operator[rows] @ problem.model.mean.astype(float),
        normal=normal,
        seen_at=stood,
        displacement=place,
        information=information,
        bound=hair[kept],
        by_camera=sensitivity.by_camera,
        camera_shift=state.camera_shift,
        camera_matrix=camera_matrix + metric,
        camera_gradient=camera_gradient - metric @ state.camera_shift.ravel(),
    )
    return observations, patches.centre[~hair & several & ~clear]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Holds, for c patches, the position along the normal at which the views of each patch correlate best, and the
    values from which this position was computed."""

    place: Float[np.ndarray, " c"]  # mm along the normal
    height: Float[np.ndarray, " c"]  # the correlation there
    variance: Float[np.ndarray, " c"]  # mm^2
    several: Bool[np.ndarray, " c"]  # two views or more see the patch
    clear: Bool[np.ndarray, " c"]  # they agree, inside the reach
    view: Int[np.ndarray, "c n"]
    value: Float[np.ndarray, "c n"]
    weights: Float[np.ndarray, " e"]
    samples: Samples
    pictures: Pictures


def find_places(
    photographs: Photographs,
    patches: Patches,
    visibility: SampleVisibility,
    views: Views,
    scale: Float[np.ndarray, " k"],
    *,
    each: Round,
) -> Places:
    """Searches every patch along its normal for the depth at which its views correlate best. ``scale`` is the number of
    pixels per mm at the head in each camera."""
    steps = np.linspace(-each.reach_mm, each.reach_mm, each.steps)
    image, noise = blur_images(photographs, each.blur_mm * scale)
    weights, seen = patches.weights(each.window_mm), visibility.facing > 0
    samples = Samples(visibility.pixel, visibility.along, seen)
    pictures = Pictures(views.size, views.offset, image, noise)
    grey = sweep(samples, pictures, steps)
    view, value = choose_views(patches, weights, visibility.facing, MIN_SEEN, MAX_VIEWS)
    peaks = find_peaks(correlate(patches, weights, view, value, seen, grey=grey, noise=noise), steps)
    blur_mm = np.maximum(each.blur_mm, MIN_BLUR_PX / scale).mean()
    centres, at = np.array([camera.centre_world for camera in visibility.cameras]), patches.centre
    spread = parallax(visibility.vertices[at], visibility.normals[at], centres, view, value)
    floor_mm = FLOOR_MM * depth_factor(spread)  # larger where the patch's views stand closer together
    variance = floor_mm**2 + (blur_mm / each.window_mm) ** 2 * (1.0 - peaks.height) / peaks.curvature
    least = MIN_CORRELATION if each.with_shading else MIN_TEXTURE_CORRELATION
    clear = peaks.inside & (peaks.height > least)
    return Places(peaks.place, peaks.height, variance, view[:, 1] >= 0, clear, view, value, weights, samples, pictures)


def head_depth_factor(head_world: Mesh, face: Int[np.ndarray, " n"], cameras: Sequence[Camera]) -> float:
    """Returns the median of ``depth_factor`` over the head's vertices ``face`` (vertices in mm). Each vertex is assumed
    to be visible in its ``MAX_VIEWS`` most frontal cameras. Returns 1 if no vertex faces two cameras."""
    points, normals = head_world.vertices[face], head_world.normals()[face]
    centres = np.array([camera.centre_world for camera in cameras])
    towards = centres[None] - points[:, None]
    cosine = np.einsum("ckx,cx->ck", towards, normals) / np.linalg.norm(towards, axis=2)
    value = np.where(cosine >= MIN_FACING, cosine, 0.0) ** 2
    view = np.argsort(-value, axis=1, kind="stable")[:, :MAX_VIEWS]
    value = np.take_along_axis(value, view, axis=1)
    several = (value > 0.0).sum(axis=1) > 1
    found = depth_factor(parallax(points[several], normals[several], centres, view[several], value[several]))
    return float(np.median(found)) if several.any() else 1.0


def metric_rig(cameras: tuple[Camera, ...], at_world: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "c c"]:
    """Returns an information matrix (inverse covariance of all cameras' corrections) that keeps the rig's size: a
    common relative change of all camera distances to the head has the standard deviation ``RIG_SCALE_SPREAD``.

    The rig's size comes from one calibration board of known size. Images alone cannot determine the rig's size:
    outlines that are a tenth of a pixel too wide would move every camera and the surface closer."""
    depth = np.array([camera.camera_from_world.apply(at_world)[2] for camera in cameras])
    nearer = np.zeros((len(depth), 6))
    nearer[:, 5] = 1.0 / (len(depth) * depth)
    return np.outer(nearer, nearer) / RIG_SCALE_SPREAD**2


def pixels_per_mm(cameras: tuple[Camera, ...], at_world: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " k"]:
    """Returns how many pixels of each camera a length of 1 mm at ``at_world`` covers."""
    return np.array([c.intrinsics.fx / c.camera_from_world.apply(at_world)[2] for c in cameras])


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """Holds the maximum of each patch's correlation along its normal."""

    place: Float[np.ndarray, " c"]  # mm along the normal
    height: Float[np.ndarray, " c"]
    curvature: Float[np.ndarray, " c"]  # mm^-2
    inside: np.ndarray  # is it a peak, and not the end of the reach?


def find_peaks(score: Float32[np.ndarray, "c d"], steps: Float[np.ndarray, " d"]) -> Peaks:
    """Finds the maximum of each patch's correlation, by a parabola through the highest value and its two neighbours."""
    best = score.argmax(axis=1)
    middle = np.clip(best, 1, len(steps) - 2)
    rows, step = np.arange(len(score)), steps[1] - steps[0]
    below, at, above = (score[rows, middle + j].astype(float) for j in (-1, 0, 1))
    curvature = np.minimum(second_difference(below, at, above), -FLATTEST)
    offset = np.clip(vertex_offset(below, above, curvature), -1.0, 1.0)
    return Peaks(
        place=steps[middle] + offset * step,
        height=np.minimum(at + 0.25 * (above - below) * offset, 1.0),
        curvature=-curvature / step**2,
        inside=best == middle,
    )


def choose_views(
    patches: Patches, weights: Float[np.ndarray, " e"], facing: Float32[np.ndarray, "k s"], least_seen: float, most: int
) -> tuple[Int[np.ndarray, "c n"], Float[np.ndarray, "c n"]]:
    """Chooses the views in which each patch is compared: at most ``most`` of the most frontal views that show at least
    the fraction ``least_seen`` of the patch. Returns view indices with weights, the squared cosine between normal and
    line of sight; missing views are -1 with weight 0."""
    total = patches.sums(weights, np.ones((facing.shape[1], 1)))
    seen = patches.sums(weights, (facing > 0).T.astype(float))
    cosine = patches.sums(weights, facing.T.astype(float)) / np.maximum(seen, 1e-9)
    value = np.where(seen > least_seen * total, cosine**2, 0.0)
    view = np.argsort(-value, axis=1, kind="stable")[:, :most]
    value = np.take_along_axis(value, view, axis=1)
    speaks = value > MIN_VIEW
    return np.where(speaks, view, -1), np.where(speaks, value, 0.0)


def sweep(samples: Samples, pictures: Pictures, steps: Float[np.ndarray, " d"]) -> Float32[np.ndarray, "s k d"]:
    """Returns each camera's grey value at every sample after the sample is moved along its normal by each of ``steps``
    (mm)."""
    cameras, count = samples.seen.shape
    out = np.zeros((count, cameras, len(steps)), np.float32)
    in_threads(count, lambda a, b: sweep_pictures(a, b, samples, pictures, steps, out))
    return out


def correlate(
    patches: Patches,
    weights: Float[np.ndarray, " e"],
    view: Int[np.ndarray, "c n"],
    value: Float[np.ndarray, "c n"],
    seen: Bool[np.ndarray, "k s"],
    *,
    grey: Float32[np.ndarray, "s k d"],
    noise: Float[np.ndarray, " k"],
) -> Float32[np.ndarray, "c d"]:
    """Returns, for each patch and each step along its normal, the mean normalised cross-correlation over all pairs of
    the patch's views; 0 if there is no pair.

    Gain and offset of a view do not change the correlation. ``noise``, the standard deviation of each camera's grey
    values, is part of the norm, so the correlation of a patch without texture is near 0. ``view`` and ``value`` come
    from ``choose_views``, ``grey`` from ``sweep``."""
    score = np.zeros((len(patches.centre), grey.shape[2]), np.float32)
    members = Members(patches.start, patches.member, weights)
    in_threads(len(score), lambda a, b: correlate_views(a, b, members, view, value, seen, grey, noise, score))
    return score


@dataclass(frozen=True, slots=True, eq=False)
class CameraSensitivity:
    """Holds, for n patches, the derivative of each patch's depth by the cameras' poses, and the quadratic form in the
    camera corrections that remains when the depth is eliminated."""

    by_camera: Float[np.ndarray, "n c"]  # d(place, mm along the normal) / d(cameras), c = 6 K
    view: Int[np.ndarray, "n v"]
    stiff: Float[np.ndarray, "n a a"]  # of the image shifts of its views, by the patch's own information
    slope: Float[np.ndarray, "n a"]
    slides: Float[np.ndarray, "n a 6"]  # d(image shifts of a view) / d(its camera)

    def cameras(self, information: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "c c"], Float[np.ndarray, " c"]]:
        """Returns the sum of all patches' quadratic forms in the camera corrections (rad, mm): its matrix, and its
        negative gradient. Each patch is weighted by its ``information`` (mm^-2)."""
        size = self.by_camera.shape[1]
        matrix, gradient = np.zeros((size, size)), np.zeros(size)
        add_cameras(self.view, self.stiff, self.slope, self.slides, information, matrix, gradient)
        return matrix, gradient


def camera_sensitivity(
    view: Int[np.ndarray, "n v"],
    value: Float[np.ndarray, "n v"],
    grams: tuple[Float[np.ndarray, "n a a"], Float[np.ndarray, "n a v"]],
    places: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "n 3"],
    cameras: tuple[Camera, ...],
) -> CameraSensitivity:
    """Computes the derivatives of n patches' depths by the cameras' poses.

    ``view``: the views of each patch, -1 for none. ``value``: their weights. ``grams``: the result of
    ``gram_matrices``. ``places``: the surface points of the patches, world, mm. ``axes``: unit normals along which they
    move, world. ``cameras``: cameras of the views, at their current poses.
    """
    slopes, mixed = grams
    axis_value = np.repeat(value, 2, axis=1)  # of the 2 v image axes
    total = np.maximum(value.sum(axis=1), 1e-12)[:, None]
    same = np.repeat(np.repeat(np.eye(value.shape[1], dtype=bool), 2, axis=0), 2, axis=1)
    across_views = axis_value[:, :, None] * axis_value[:, None, :] / total[:, :, None]
    matrix = slopes * (axis_value[:, :, None] * same - across_views)
    own_shade = np.take_along_axis(mixed, (np.arange(axis_value.shape[1]) // 2)[None, :, None], axis=2)[:, :, 0]
    gradient = axis_value * (own_shade - np.einsum("nav,nv->na", mixed, value / total))
    ahead, slides = np.zeros(axis_value.shape), np.zeros((*axis_value.shape, 6))
    write_image_motion(view, places, axes, np.stack([packed_camera(camera) for camera in cameras]), ahead, slides)
    # The surface moves freely: u = - (ahead . (H delta + gradient)) / (ahead . H ahead).
    across = np.einsum("nab,nb->na", matrix, ahead)
    curvature = np.einsum("na,na->n", ahead, across)
    curvature = np.where(curvature > 1e-12, curvature, np.inf)[:, None]
    down = np.einsum("na,na->n", ahead, gradient)[:, None]
    by_camera = np.zeros((len(view), 6 * len(cameras)))
    add_by_camera(view, -across / curvature, slides, by_camera)
    return CameraSensitivity(
        by_camera=by_camera,
        view=view,
        stiff=(matrix - across[:, :, None] * across[:, None, :] / curvature[:, :, None]) / curvature[:, :, None],
        slope=(gradient - across * down / curvature) / curvature,
        slides=slides,
    )


def gram_matrices(
    patches: Patches,
    chosen: Int[np.ndarray, " n"],
    weights: Float[np.ndarray, " e"],
    view: Int[np.ndarray, "n v"],
    shifts: Float[np.ndarray, " n"],
    *,
    samples: Samples,
    pictures: Pictures,
) -> tuple[Float[np.ndarray, "n a a"], Float[np.ndarray, "n a v"]]:
    """Computes inner products for the ``chosen`` patches, with the surface moved by ``shifts`` (mm along the normals):
    between the image derivatives of a patch's views (two axes for each view), and between these derivatives and the
    grey values."""
    count, views = view.shape
    slopes, mixed = np.zeros((count, 2 * views, 2 * views)), np.zeros((count, 2 * views, views))
    members = Members(patches.start, patches.member, weights)
    in_threads(count, lambda a, b: write_grams(a, b, chosen, members, view, shifts, samples, pictures, slopes, mixed))
    return slopes, mixed
