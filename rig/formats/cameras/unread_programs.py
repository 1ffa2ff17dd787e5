"""Recognises files of cameras, by their names and beginnings, that programs write and nothing here reads.

A capture without cameras of a known format is one of photographs alone, whose cameras are found anew. Whoever put other
cameras beside them is told that they were not read.
"""

from fnmatch import fnmatch
from pathlib import Path

from rig.messages.fault_groups import some_of
from rig.messages.message import Message, compose
from rig.text import as_utf8

HEAD_BYTES = 1 << 16  # the words by which an XMP file is recognised stand near its beginning
PATTERNS = (
    ("transforms_*.json", "transforms.json in parts: join their frames in one transforms.json"),
    ("poses_bounds.npy", "LLFF"),
    ("cameras*.npz", "NeuS, IDR"),
    ("*.sfm", "Meshroom"),
    ("sfm_data*.json", "OpenMVG"),
    ("bundle*.out", "Bundler"),
    ("*.nvm", "VisualSFM"),
    ("*calibrated_camera_parameters*.txt", "Pix4D"),
    ("database.db", "COLMAP without a model: export it to sparse/0"),
    ("*.ps[xz]", "Metashape: export its cameras as XML"),
    ("*.r[cs]proj", "RealityCapture: export its cameras as XMP or CSV"),
    ("*.fbx", "FBX: export COLMAP's model or transforms.json"),
    ("*.abc", "Alembic: export COLMAP's model or transforms.json"),
    ("*.mat", "MATLAB: write OpenCV's YAML"),
    ("*.p4[dm]", "Pix4D: export its calibrated cameras as OpenCV's YAML"),
    ("*.qca.txt", "Qualisys: write cameras.json"),
    ("*.xcp", "Vicon: write cameras.json"),
    ("*_cam.txt", "MVSNet: export COLMAP's model"),
    ("*.usd[ac]", "USD: export COLMAP's model or transforms.json"),
    ("*.opk", "positions and omega, phi, kappa without lenses: export Metashape's XML"),
    ("*.chan", "Nuke's camera over time: export one camera a file of a program that is read"),
)  # fmt: skip
OPENCV_KEYS = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "\nK1:", "\nM1:")
OPENCV = "OpenCV's calibration of one camera or a pair: write K_<name>, dist_<name>, R_<name> and T_<name> of all"
CONTENTS = (  # endings, words of which a file holds one, and its program
    ((".yaml", ".yml"), ("T_cn_cnm1", "distortion_model:"), "Kalibr: write its chain as OpenCV's YAML or cameras.json"),
    ((".yaml", ".yml", ".xml"), OPENCV_KEYS, OPENCV),
    ((".xml",), ("<BlocksExchange",), "ContextCapture's BlocksExchange: export Metashape's XML or COLMAP's model"),
    ((".json",), ('"Calibration"', '"libCalib'), "calib.io: export OpenCV's YAML"),
    ((".json",), ('"intrinsic_matrix"',), "Open3D: write one transforms.json of all cameras"),
    ((".json",), ('"sfm_data_version"',), "OpenMVG: export COLMAP's model"),
    ((".json",), ('"camera_poses"',), "MultiCal: write OpenCV's YAML"),
    ((".json",), ('"distCoef"',), "Panoptic Studio: write OpenCV's YAML"),
    ((".json",), ('"projection_type"',), "OpenSfM: export COLMAP's model"),
)  # fmt: skip


def unread_programs(folder: Path) -> list[Message]:
    """Returns, for each program, the files of cameras in ``folder`` that are not read."""
    files: dict[str, list[str]] = {}
    for path in sorted(folder.iterdir()):
        if path.is_file() and (program := program_of(path)):
            files.setdefault(program, []).append(path.name)
    return [compose("cameras-of-program", files=some_of(names), program=program) for program, names in files.items()]


def program_of(path: Path) -> str | None:
    """Returns the program that wrote a file of cameras which is not read, and a remedy; None for another file."""
    named = (program for pattern, program in PATTERNS if fnmatch(path.name.lower(), pattern))
    held = (
        program
        for endings, words, program in CONTENTS
        if path.suffix.lower() in endings and any(word in head_of(path) for word in words)
    )
    return next(named, None) or next(held, None)


def head_of(path: Path) -> str:
    """Returns the beginning of a text, by which its format is recognised; nothing if it cannot be read."""
    try:
        with path.open("rb") as file:
            return as_utf8(file.read(HEAD_BYTES)).decode("utf-8", "replace")
    except (OSError, ValueError):
        return ""
