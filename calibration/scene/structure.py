"""Estimates cameras and points from matches by COLMAP's incremental structure from motion, which starts from the best
pair of views and adds the others one by one.

The method is that of J. L. Schoenberger, J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016. The structure's unit
of length and frame are arbitrary. The centre of the top-left pixel is (0.5, 0.5) in COLMAP and (0, 0) in this project,
so principal points and keypoints are shifted.
"""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from calibration.scene.matching import SEED, Matches, quiet
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform
from rig.messages.message import Message, compose
from rig.progress import Progress
from rig.rig import Rig

if TYPE_CHECKING:
    import pycolmap

HALF_PIXEL = 0.5
FEATURES_LEAST = 100  # of a view; sharp pictures of a head have a thousand
CENTRE_VIEWS = 10  # of one lens, from which its principal point is estimated; fewer leave it to the picture's middle
INITIAL_LEAST, SEEN_LEAST = 50, 15  # matches of the first pair, points of a view that joins; half of COLMAP's own
TRACK_LEAST = 3  # a point in two views only tells nothing about the third; and cannot be told from a wrong match


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Holds the cameras and points from structure from motion, in an arbitrary frame and unit.

    Observation i is the pixel ``pixels[i]`` of the point ``point_of[i]`` in the camera ``camera_of[i]``. If
    ``one_lens`` is True, all cameras have the same intrinsics.
    """

    rig: Rig
    points: Float[np.ndarray, "p 3"]
    camera_of: Int[np.ndarray, " n"]
    point_of: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]
    one_lens: bool

    @property
    def estimated(self) -> int:
        """Returns how many lens parameters, in the order f, k1, k2, cx, cy, were estimated."""
        if not self.one_lens:
            return 1
        return 5 if len(self.rig) >= CENTRE_VIEWS else 3

    def residuals(self) -> Float[np.ndarray, "n 2"]:
        """Returns the projected minus the observed pixel of each observation."""
        projected = np.empty_like(self.pixels)
        for index, camera in enumerate(self.rig):
            of_camera = self.camera_of == index
            projected[of_camera] = camera.project(self.points[self.point_of[of_camera]])
        return projected - self.pixels


def solve_structure(matches: Matches, scratch: Path, *, report: Progress) -> Structure | None:
    """Estimates the cameras and points of the largest connected set of views. Returns None if no pair of views is
    suitable as a start.

    If each camera has its own lens, the estimate starts from the single lens that fits all views best. The distortion
    of this lens is kept, because the 300 points of a view cannot separate distortion from noise. A good initial lens is
    needed because one view of a head cannot separate focal length from distance.
    """
    import pycolmap

    best, lens = None, None
    with quiet():
        for number, database in enumerate(matches.databases):
            report("structure", number / len(matches.databases))
            _start_lenses(database, lens)
            pycolmap.set_random_seed(SEED)
            models = scratch / f"models-{number}"
            models.mkdir()
            reconstructions = pycolmap.incremental_mapping(database, scratch / "pictures", models, _pipeline_options())
            best = max(reconstructions.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
            if best is not None:
                one = len(best.cameras) == 1
                _adjust(best, one_lens=one, principal_point=one and best.num_reg_images() >= CENTRE_VIEWS)
                lens = next(iter(best.cameras.values())).params
    return None if best is None else _structure(best, one_lens=matches.one_lens)


def _start_lenses(path: Path, lens: Float[np.ndarray, " 5"] | None) -> None:
    """Sets the initial focal length and distortion of every camera in a database. None keeps COLMAP's guess."""
    import pycolmap

    if lens is None:
        return
    database = pycolmap.Database.open(path)
    try:
        for camera in database.read_all_cameras():
            camera.params = [float(value) for value in (lens[0], *camera.params[1:3], *lens[3:])]
            database.update_camera(camera)
    finally:
        database.close()


def _pipeline_options() -> "pycolmap.IncrementalPipelineOptions":
    """Returns options that do not estimate distortion while views are added. Distortion fitted to three views would
    exclude a fourth view."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.extract_colors = False
    options.min_model_size = 3
    options.max_num_models = 4  # the largest is taken; later ones are made of what the first left
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_num_inliers = INITIAL_LEAST
    options.mapper.abs_pose_min_num_inliers = SEEN_LEAST
    return options


def _adjust(model: "pycolmap.Reconstruction", *, one_lens: bool, principal_point: bool) -> None:
    """Runs a final bundle adjustment with a robust loss, because COLMAP accepts wrong matches below four pixels."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point, options.refine_extra_params = principal_point, one_lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _structure(model: "pycolmap.Reconstruction", *, one_lens: bool) -> Structure:
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    cameras = tuple(_camera(Path(image.name).parts[0], image, model.cameras[image.camera_id]) for image in images)
    index_of = {image.image_id: index for index, image in enumerate(images)}
    ids = sorted(key for key, point in model.points3D.items() if point.track.length() >= TRACK_LEAST)
    camera_of, point_of, pixels = [], [], []
    for index, key in enumerate(ids):
        for element in model.points3D[key].track.elements:
            camera_of.append(index_of[element.image_id])
            point_of.append(index)
            pixels.append(model.images[element.image_id].points2D[element.point2D_idx].xy - HALF_PIXEL)
    points = np.array([model.points3D[key].xyz for key in ids]).reshape(-1, 3)
    observed = np.array(pixels, dtype=float).reshape(-1, 2)
    return Structure(Rig(cameras), points, np.array(camera_of, int), np.array(point_of, int), observed, one_lens)


def _camera(name: str, image: Any, lens: Any) -> Camera:
    focal, cx, cy, k1, k2 = lens.params
    intrinsics = Intrinsics(lens.width, lens.height, focal, focal, cx - HALF_PIXEL, cy - HALF_PIXEL, Distortion(k1, k2))
    pose = image.cam_from_world()
    return Camera(name, intrinsics, RigidTransform(pose.rotation.matrix(), np.asarray(pose.translation)))


def explain_missing_view(name: str, matches: Matches, joined: Collection[str]) -> Message:
    """Explains why a view could not be joined to the others, and what to add."""
    features = matches.features[name]
    if features < FEATURES_LEAST:
        return compose("join-points-bare", points=features)
    others = {b if a == name else a: n for (a, b), n in matches.matched.items() if name in (a, b) and n}
    if not others:
        return compose("join-points-alone", points=features)
    best = max(others, key=lambda other: others[other])
    code = "join-points-few" if best in joined or not joined else "join-points-few-neither"
    return compose(code, points=others[best], other=best)
