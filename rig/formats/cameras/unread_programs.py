"""Recognises files of cameras, by their names and beginnings, that programs write and nothing here reads.

A capture without cameras of a known format is one of photographs alone, whose cameras are found anew. Whoever put other
cameras beside them is told that they were not read.
"""

from collections.abc import Iterator
from pathlib import Path

from rig.messages.fault_groups import some_of
from rig.messages.message import Message, compose

HEAD_BYTES = 4096
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
)  # fmt: skip
OPENCV_KEYS = (b"camera_matrix", b"cameraMatrix", b"Camera_Matrix", b"\nK1:", b"\nM1:")
OPENCV = "OpenCV's calibration of one camera or a pair: write K_<name>, dist_<name>, R_<name> and T_<name> of all"


def unread_programs(folder: Path) -> list[Message]:
    """Returns, for each program, the files of cameras in ``folder`` that are not read."""
    files: dict[str, list[str]] = {}
    for name, program in _recognised(folder):
        files.setdefault(program, []).append(name)
    return [compose("cameras-of-program", files=some_of(names), program=program) for program, names in files.items()]


def _recognised(folder: Path) -> Iterator[tuple[str, str]]:
    for pattern, program in PATTERNS:
        yield from ((path.name, program) for path in sorted(folder.glob(pattern)) if path.is_file())
    for path in sorted({*folder.glob("*.yml"), *folder.glob("*.yaml"), *folder.glob("*.xml")}):
        if any(key in _beginning(path) for key in OPENCV_KEYS):
            yield path.name, OPENCV


def _beginning(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError:
        return b""
