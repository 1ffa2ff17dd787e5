"""Declares how the readers treat each key in the camera files of other programs.

A reader of camera files uses a key that is ``read``. A key that is ``refused`` changes a camera in a way that this
project cannot represent, so a file with a value that has an effect is refused. The reader ignores the value of a key
that is ``told``, and reports the key by the warning ``unknown-key``. A key that is ``nothing`` has no influence on
poses and lenses. Unlisted keys also give a warning. ``docs/foreign-cameras.md`` is generated from this module."""

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

from rig.messages.message import Message, compose

Treatment = Literal["read", "refused", "told", "nothing"]


class ForeignKey(NamedTuple):
    """Holds the rule for one key of a file.

    ``why`` says what the key means, or why it is not read. ``silent`` lists the values at which a refused or reported
    key has no effect, as if it were missing. If the value is a list, all its elements must be in ``silent``.
    """

    treatment: Treatment
    why: str | Message
    silent: tuple[str | float | bool, ...] = ()


Table = Mapping[str, ForeignKey]


def says_nothing(value: object, rule: ForeignKey) -> bool:
    """Returns whether ``value`` is missing or has no effect according to ``rule``."""
    return all(any(_plain(part) == _plain(one) for one in rule.silent) for part in _parts(value))


def _parts(value: object) -> Iterator[object]:
    if isinstance(value, list | tuple):
        for part in value:
            yield from _parts(part)
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from _parts(part)
    elif isinstance(value, str):
        yield from value.split()
    elif value is not None:
        yield value


def _plain(value: object) -> str | float:
    """Converts numbers and Boolean values to a comparable form, because files write the same value differently."""
    text = str(value).strip().casefold()
    try:
        return {"true": 1.0, "false": 0.0}[text] if text in ("true", "false") else float(text)
    except ValueError:
        return text


def _keys(treatment: Treatment, why: str | Message, *keys: str, silent: tuple[str | float | bool, ...] = ()) -> Table:
    return {key: ForeignKey(treatment, why, silent) for key in keys}


SINGLE = compose("key-one-time")

METASHAPE: Table = {
    **_keys("read", "the name: a picture's ending and folders are taken off", "camera@label"),
    **_keys("read", "`false` or `0`: the camera takes no part, and a warning says so", "camera@enabled"),
    **_keys("read", "the lens", "camera@sensor_id", "sensor@id"),
    **_keys("read", "its `transform` takes the camera to the world", "camera@component_id", "component@id"),
    **_keys("refused", compose("key-slave-camera"), "camera@master_id"),
    **_keys("nothing", "", "camera@id", "component@label", "component@active"),
    **_keys("read", "chunk_from_camera; a camera without one is not aligned and takes no part", "camera/transform"),
    **_keys("nothing", "rows and columns are the sensor's, as in the files", "camera/orientation"),
    **_keys("nothing", "", "camera/rotation_covariance", "camera/location_covariance", "camera/reference"),
    **_keys("nothing", "", "camera/meta", "camera/photo", "camera/color", "camera/property"),
    **_keys("told", SINGLE, "camera/rolling_shutter", silent=()),
    **_keys("read", "the camera's name where labels repeat", "group@label"),
    **_keys("nothing", "", "group@id", "group@type", "group@enabled"),
    **_keys("read", "`frame`, `fisheye` and `equidistant_fisheye`; others are refused", "sensor@type"),
    **_keys("refused", compose("key-slave-sensor"), "sensor@master_id"),
    **_keys("read", "the size in pixels", "sensor/resolution", "calibration/resolution"),
    **_keys(
        "told", SINGLE, "sensor/rolling_shutter", "sensor/property[rolling_shutter]", silent=(0, "disabled", "none")
    ),
    **_keys("nothing", "nominal values", "sensor/property[pixel_width]", "sensor/property[pixel_height]"),
    **_keys("nothing", "nominal values", "sensor/property[focal_length]", "sensor/property[sensor_width]"),
    **_keys("nothing", "", "sensor@label", "sensor/bands", "sensor/data_type", "sensor/covariance", "sensor/meta"),
    **_keys("nothing", "", "sensor/property[layer_index]", "sensor/property[fixed]", "sensor/property[fixed_params]"),
    **_keys("nothing", "", "sensor/property[normalize_sensitivity]", "sensor/vignetting", "sensor/photo_params"),
    **_keys("nothing", "", "sensor/black_level", "sensor/sensitivity", "sensor/fixed_calibration", "sensor/planes"),
    **_keys("read", "`adjusted` before `initial`", "calibration@class"),
    **_keys("refused", compose("key-other-type"), "calibration@type"),
    **_keys("read", "the focal length, and what fx has more", "calibration/f", "calibration/b1"),
    **_keys("read", "the principal point, off the middle of the picture", "calibration/cx", "calibration/cy"),
    **_keys("read", "the skew, taken out of the pictures", "calibration/b2"),
    **_keys(
        "read", "the lens", "calibration/k1", "calibration/k2", "calibration/k3", "calibration/p1", "calibration/p2"
    ),
    **_keys(
        "read", "fitted by k1 k2 k3; refused where they miss it by 0.02 px. Of a fisheye as it is", "calibration/k4"
    ),
    **_keys("refused", compose("key-calibrate-without"), "calibration/p3", "calibration/p4", silent=(0,)),
    **_keys("refused", compose("key-photoscan"), "calibration/fx", "calibration/fy", "calibration/skew"),
    **_keys("nothing", "", "calibration/date", "calibration/projection"),
    **_keys(
        "read", "world_from_chunk, of the component or the chunk: rotation, translation and scale", "chunk/transform"
    ),
    **_keys("read", "world_from_chunk of its cameras", "component/transform"),
    **_keys("read", "a second chunk with aligned cameras is refused", "chunk"),
    **_keys("nothing", "", "chunk@label", "chunk@enabled", "chunk/reference", "chunk/region", "chunk/settings"),
    **_keys("read", "lists of the above", "chunk/sensors", "chunk/components", "chunk/cameras"),
    **_keys("nothing", "", "chunk/markers", "chunk/scalebars"),
    **_keys(
        "nothing", "", "chunk/images", "chunk/meta", "chunk/frames", "chunk/R", "chunk/keyframes", "chunk/modifier"
    ),
    **_keys("nothing", "", "chunk@version", "component/region", "component/partition", "component/reference"),
}

REALITYCAPTURE: Table = {
    **_keys(
        "read", "camera_from_world; without it and `Position` the camera is not aligned and takes no part", "Rotation"
    ),
    **_keys("read", "the camera's centre, in metres", "Position"),
    **_keys("read", "of a film whose longer side is 36 mm", "FocalLength35mm"),
    **_keys("read", "the principal point, off the middle, in longer sides", "PrincipalPointU", "PrincipalPointV"),
    **_keys("read", "fy / fx", "AspectRatio"),
    **_keys("refused", compose("key-skew"), "Skew", silent=(0,)),
    **_keys(
        "read",
        "`perspective` and `brown3` to `brown4t2`; `division` only where its coefficients are 0, others are refused",
        "DistortionModel",
    ),
    **_keys("read", "k1 k2 k3 k4 t1 t2; k4 as Metashape's", "DistortionCoeficients"),
    **_keys("read", "`0`: the camera takes no part, and a warning says so", "InMeshing"),
    **_keys("read", "two components stand in no known place to each other, and are refused", "ComponentId"),
    **_keys("told", compose("key-colours"), "InTexturing", "InColoring", silent=(1,)),
    **_keys("told", compose("key-metres"), "Coordinates", silent=("absolute",)),
    **_keys("told", compose("key-draft"), "PosePrior", silent=("locked", "exact")),
    **_keys("told", compose("key-globe"), "Latitude", "Longitude", "Altitude", "GpsLatitude", "GpsLongitude"),
    **_keys("nothing", "", "Version", "CalibrationPrior", "CalibrationGroup", "DistortionGroup", "GravityDirection"),
    **_keys("nothing", "", "Rig", "RigInstance", "RigPoseIndex", "LensGroup"),
}

REALITYCAPTURE_CSV: Table = {
    **_keys("read", "the name: a picture's ending and folders are taken off", "#name"),
    **_keys("read", "the camera's centre, in metres", "x", "y", "alt"),
    **_keys("read", "degrees; at 0 0 0 the camera looks down, its top to the north", "heading", "pitch", "roll"),
    **_keys("read", "of a film whose longer side is 36 mm; the principal point in its millimetres", "f", "px", "py"),
    **_keys("read", "k4 as Metashape's", "k1", "k2", "k3", "k4", "t1", "t2"),
}

COLMAP: Table = {
    **_keys("read", "a pinhole", "SIMPLE_PINHOLE", "PINHOLE"),
    **_keys("read", "Brown-Conrady", "SIMPLE_RADIAL", "RADIAL", "OPENCV"),
    **_keys("read", "rational where k4, k5 or k6 is not 0", "FULL_OPENCV"),
    **_keys("read", "Kannala-Brandt", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
    **_keys("read", "Kannala-Brandt without coefficients", "SIMPLE_FISHEYE", "FISHEYE"),
    **_keys("refused", "undistort the pictures, or calibrate with OPENCV", "FOV", "SIMPLE_DIVISION", "DIVISION"),
    **_keys("refused", "undistort the pictures, or calibrate with OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "EUCM"),
    **_keys("refused", "undistort the pictures, or calibrate with OPENCV_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    **_keys("refused", "no lens of one camera", "EQUIRECTANGULAR"),
    **_keys("read", "of cameras.*: the size in pixels, the lens", "CAMERA_ID", "WIDTH", "HEIGHT", "PARAMS[]"),
    **_keys("read", "of images.*: camera_from_world", "QW QX QY QZ", "TX TY TZ"),
    **_keys("read", "the camera's name: the file's, or its folder's where those repeat", "NAME"),
    **_keys("nothing", "an image without its line of points is read all the same", "POINTS2D[]"),
    **_keys("nothing", "poses stand in images.*", "IMAGE_ID", "rigs.*", "frames.*", "points3D.*"),
    **_keys("told", "a second model, with cameras that joined no other (`file-unread`)", "sparse/1"),
}

TRANSFORMS: Table = {
    **_keys("read", "`PINHOLE`, `SIMPLE_PINHOLE`, `OPENCV`, `OPENCV_FISHEYE`; others are refused", "camera_model"),
    **_keys("read", "`true`: OPENCV_FISHEYE; refused beside another `camera_model`", "is_fisheye"),
    **_keys("read", "the focal length", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y"),
    **_keys("read", "the principal point; without it the middle", "cx", "cy"),
    **_keys("read", "the size in pixels; without it that of the picture", "w", "h"),
    **_keys("read", "the lens", "k1", "k2", "k3"),
    **_keys("read", "refused of a fisheye, which has none", "p1", "p2"),
    **_keys("read", "of a fisheye; else refused: calibrate without it", "k4"),
    **_keys("refused", compose("key-calibrate-without"), "k5", "k6", silent=(0,)),
    **_keys("read", "a camera each; what stands in a frame goes before what stands at the top", "frames"),
    **_keys(
        "read", "the name: a picture's ending is taken off, and the folder is the name where names repeat", "file_path"
    ),
    **_keys("read", "world_from_camera, axes as OpenGL's, 4 x 4 or 3 x 4", "transform_matrix"),
    **_keys("refused", compose("key-moving"), "transform_matrix_start"),
    **_keys("refused", compose("key-moving"), "transform_matrix_end"),
    **_keys("refused", compose("key-rolling-shutter"), "rolling_shutter", silent=(0,)),
    **_keys("refused", compose("key-orientation"), "orientation_override"),
    **_keys("read", "taken back from the translations", "applied_scale"),
    **_keys(
        "read",
        "a rotation says nothing (any world will do); with a scale or mirrored it is refused",
        "applied_transform",
    ),
    **_keys("told", compose("key-masks"), "mask_path"),
    **_keys("told", compose("key-depths"), "depth_file_path", "depth_path", silent=()),
    **_keys("told", compose("key-crop"), "crop"),
    **_keys("told", compose("key-all-frames"), "train_filenames", "val_filenames", "test_filenames"),
    **_keys("nothing", "of the radiance field's own box, not of the cameras", "aabb_scale", "scale", "offset", "aabb"),
    **_keys("nothing", "", "up", "from_na", "n_extra_learnable_dims", "sharpness", "ply_file_path", "colmap_im_id"),
    **_keys("nothing", "", "rotation", "white_transparent", "black_transparent", "fix_premult", "render_aabb"),
    **_keys("nothing", "", "frame_id", "enable_depth_loading", "integer_depth_scale", "sharpen", "envmap", "timestamp"),
    **_keys("nothing", "of a data set that `eigenhead export` wrote", "unit", "fg_mask_path", "camera_index"),
    **_keys("nothing", "of a data set that `eigenhead export` wrote", "camera_indices"),
    **_keys("read", "one moment is read: the first of `timestep_indices`", "timestep_index", "timestep_indices"),
    **_keys("nothing", "", "camera_id", "auxiliary_data", "format_version", "dataset_id", "ids", "time", "fps"),
    **_keys("nothing", "", "num_exposures"),
}

CALISCOPE: Table = {
    **_keys("read", "the name; without it `cam_` and the table's number", "name"),
    **_keys("read", "`true`: the camera takes no part, and a warning says so", "ignore"),
    **_keys("read", "`true`: `distortions` are Kannala-Brandt's", "fisheye"),
    **_keys("refused", compose("key-turned"), "rotation_count", silent=(0,)),
    **_keys("read", "the size in pixels", "size"),
    **_keys("read", "the camera matrix; skew is taken out", "matrix"),
    **_keys("read", "OpenCV's, at most 8 (of a fisheye 4); more are refused unless 0", "distortions"),
    **_keys("read", "camera_from_world, a matrix or a vector; without pose the camera takes no part", "rotation"),
    **_keys("read", "camera_from_world, in metres", "translation"),
    **_keys("nothing", "", "cam_id", "port", "error", "exposure", "grid_count", "verified_resolutions"),
}

ANIPOSELIB: Table = {
    **{key: CALISCOPE[key] for key in ("name", "fisheye", "size", "matrix", "distortions")},
    **_keys("read", "camera_from_world, a vector or a matrix", "rotation"),
    **_keys("read", "camera_from_world", "translation"),
    **_keys("read", "`mm`, `cm` or `m`; others are refused. Without it the size of the rig tells", "metadata.unit"),
    **_keys("nothing", "", "metadata.adjusted", "metadata.error"),
}

OPENCV_YAML: Table = {
    **_keys("read", "the cameras that take part; others in the file do not, and a warning says so", "names"),
    **_keys("read", "the camera matrix; skew is taken out", "K_<name>"),
    **_keys("read", "OpenCV's, at most 8; more are refused unless 0. Without it there is none", "dist_<name>"),
    **_keys("read", "camera_from_world: a rotation vector or matrix; refused where the two disagree", "R_<name>"),
    **_keys("read", "camera_from_world: a matrix", "Rot_<name>"),
    **_keys("read", "camera_from_world", "T_<name>"),
    **_keys("read", "the size in pixels; without it that of the picture", "W_<name>", "H_<name>"),
    **_keys("refused", compose("key-dist-name"), "D_<name>", "distCoeffs_<name>", silent=(0,)),
    **_keys("refused", compose("key-omnidirectional"), "xi_<name>", silent=(0,)),
    **_keys("refused", compose("key-fisheye"), "fisheye_<name>", silent=(0,)),
}

FOREIGN_KEYS: Mapping[str, tuple[str, Table]] = {
    "metashape": ("Metashape: cameras as XML", METASHAPE),
    "realitycapture": ("RealityCapture, RealityScan: XMP beside the pictures", REALITYCAPTURE),
    "realitycapture-csv": ("RealityCapture: CSV of internal and external parameters", REALITYCAPTURE_CSV),
    "colmap": ("COLMAP: `cameras.*` and `images.*`, models and columns", COLMAP),
    "nerfstudio": ("nerfstudio, instant-ngp: `transforms.json`, at the top or in a frame", TRANSFORMS),
    "caliscope": ("caliscope: `camera_array.toml`", CALISCOPE),
    "aniposelib": ("aniposelib: any TOML with its keys", ANIPOSELIB),
    "opencv-yaml": ("OpenCV's YAML, EasyMocap", OPENCV_YAML),
}
