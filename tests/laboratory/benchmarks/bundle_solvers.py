"""The bundle's own solver beside scipy's (sparse Jacobian) and Ceres (through pycolmap), on one and the same problem.

Eleven cameras, thirty shots, 0.2 px noise, from the same perturbed start, plain least squares. Run from the root:
``python -m tests.laboratory.benchmarks.bundle_solvers``. Prints JSON: CPU and wall seconds, final RMS in pixels.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix

from calibration.adjustment.bundle import Free, free_mask, solve
from calibration.adjustment.corner_term import CornerTerm, places
from calibration.adjustment.lens_prior import weak_prior
from calibration.adjustment.state import BundleState, Observations, moved_state, observations, residuals
from tests.support.board_sessions import Session, session


def start(source: Session, rng: np.random.Generator) -> tuple[BundleState, Observations]:
    """The planted state, off by 1 % in focal length, 0.3 degrees and some millimetres."""
    rig, d = source.rig, source.detections
    seen = observations(d.views, rig.names, d.shots, d.board)
    state = BundleState(
        np.stack([camera.intrinsics.values() for camera in rig]),
        np.stack([camera.camera_from_world.rotation for camera in rig]),
        np.stack([camera.camera_from_world.translation for camera in rig]),
        np.stack([source.poses[shot].rotation for shot in d.shots]),
        np.stack([source.poses[shot].translation for shot in d.shots]),
        np.zeros(len(rig)),
        np.zeros((len(d.shots), 6)),
    )
    mask = free_mask(state, Free())
    step = np.zeros(len(mask))
    sizes = np.concatenate([np.tile([16, 16, 5, 5, 0.01, 0, 0, 0, 0, *[0.005] * 3, *[5.0] * 3], len(rig))])
    step[: len(sizes)] = sizes * rng.normal(size=len(sizes))
    return moved_state(state, step * mask), seen


def ours(state: BundleState, seen: Observations) -> float:
    prior = weak_prior([(1024, 768)] * len(state.intrinsics))
    solution = solve(state, seen, prior, np.full(len(state.intrinsics), 0.2))
    return rms(residuals(solution.state, seen))


def scipys(state: BundleState, seen: Observations) -> float:
    mask = free_mask(state, Free())

    def at(step: np.ndarray) -> BundleState:
        full = np.zeros(len(mask))
        full[mask] = step
        return moved_state(state, full)

    def jacobian(step: np.ndarray) -> coo_matrix:
        here = CornerTerm(seen, np.ones(len(state.intrinsics))).at(at(step))
        count, cameras = len(seen.points), len(state.intrinsics)
        columns = np.repeat(places(seen, cameras, len(mask))[seen.view_of][:, None], 2, axis=1)
        rows = np.broadcast_to(np.arange(2 * count).reshape(count, 2, 1), columns.shape)
        values = here.by_view()
        matrix = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(2 * count, len(mask)))
        return matrix.tocsr()[:, mask]

    found = least_squares(
        lambda step: residuals(at(step), seen).ravel(),
        np.zeros(mask.sum()),
        jacobian,  # pyright: ignore[reportArgumentType] scipy takes a callable, its stubs know only names
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=200,
        ftol=1e-8,
    )
    return rms(found.fun.reshape(-1, 2))


def colmaps(source: Session, state: BundleState, seen: Observations) -> float:
    """The board's corners as constant points, one image a view, one frame a shot, one rig of all cameras. COLMAP's
    OPENCV model has no k3, which is zero in the planted lenses."""
    model = pycolmap.Reconstruction()
    for i, values in enumerate(state.intrinsics, start=1):
        fx, fy, cx, cy, *lens = values
        parameters = [fx, fy, cx + 0.5, cy + 0.5, *lens[:4]]
        model.add_camera(pycolmap.Camera(camera_id=i, model="OPENCV", width=1024, height=768, params=parameters))
    rig = pycolmap.Rig(rig_id=1)
    for i in range(1, len(state.intrinsics) + 1):
        sensor = pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=i)
        if i == 1:
            rig.add_ref_sensor(sensor)
        else:
            pose = state.camera_pose(i - 1) @ state.camera_pose(0).inverse()
            rig.add_sensor(sensor, pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation))
    model.add_rig(rig)
    board = source.detections.board.corners()
    ids = [model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8)) for point in board]
    frames = {}
    for shot in range(len(state.board_rotations)):
        frame = pycolmap.Frame(frame_id=shot + 1, rig_id=1)
        reference = state.camera_pose(0)
        rotation = reference.rotation @ state.board_rotations[shot]
        translation = reference.rotation @ state.board_translations[shot] + reference.translation
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        frames[shot] = frame
    views = list(zip(seen.camera, seen.shot, strict=True))
    for number, (camera, shot) in enumerate(views, start=1):
        frames[shot].add_data_id(
            pycolmap.data_t(pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=int(camera) + 1), number)
        )
    for frame in frames.values():
        model.add_frame(frame)
    for number, (camera, shot) in enumerate(views, start=1):
        span = slice(seen.starts[number - 1], seen.starts[number])
        pixels = seen.pixels[span] + 0.5
        image = pycolmap.Image(name=f"{number}", keypoints=pixels, camera_id=int(camera) + 1, image_id=number)
        image.frame_id = int(shot) + 1
        model.add_image(image)
        for index, corner in enumerate(source.detections.views[number - 1].found.ids):
            model.add_observation(ids[corner], pycolmap.TrackElement(number, index))
    for shot in frames:
        model.register_frame(shot + 1)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.refine_sensor_from_rig = True
    options.refine_points3D = False
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    return float(model.compute_mean_reprojection_error())


def rms(misses: np.ndarray) -> float:
    return float(np.sqrt((misses**2).sum(axis=1).mean()))


def timed(run: Callable[[], float]) -> dict[str, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    error = run()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu, "error_px": error}


def main() -> None:
    source = session()
    state, seen = start(source, np.random.default_rng(0))
    ours(state, seen)  # compiles
    table = {
        "own Levenberg-Marquardt": timed(lambda: ours(state, seen)),
        "scipy least_squares, trf, sparse Jacobian": timed(lambda: scipys(state, seen)),
        "Ceres through pycolmap (mean error, not RMS)": timed(lambda: colmaps(source, state, seen)),
    }
    sys.stdout.write(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
