"""Damaged and foreign rig files: each fault is named, and damage always ends in InputError."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.errors import InputError
from rig.formats.cameras.cameras_file import read_rig_file, write_rig_file
from tests.support.fan_rig import NAMES, fan, find_cameras, square, write_blanks


def corrupted(kind: str, folder: Path) -> Path:
    """A rig file with one or more faults, named by the key of the table below."""
    form = {"text": "colmap-text", "binary": "colmap", "toml": "aniposelib"}[kind.split(":")[0]]
    write_rig_file(fan(), folder / NAMES[form], form)
    path = find_cameras(folder)
    images = path.with_name(f"images{path.suffix}")
    match kind:
        case "binary: truncated cameras":
            path.write_bytes(path.read_bytes()[:-30])
        case "binary: truncated images":
            images.write_bytes(images.read_bytes()[:-3])
        case "binary: empty":
            path.write_bytes(b"")
        case "binary: a huge count":
            path.write_bytes(struct.pack("<Q", 1 << 60) + path.read_bytes()[8:])
        case "binary: a huge count of points":
            images.write_bytes(images.read_bytes()[:-8] + struct.pack("<Q", 1 << 62))
        case "binary: NaN focal length":
            data = bytearray(path.read_bytes())
            data[8 + 24 : 8 + 32] = struct.pack("<d", float("nan"))
            path.write_bytes(data)
        case "binary: fisheye":
            data = bytearray(path.read_bytes())
            data[12:16] = struct.pack("<i", 7)  # FOV
            path.write_bytes(data)
        case "binary: no images file":
            images.unlink()
        case "text: NaN translation" | "text: zero quaternion":
            first, *rest = (line for line in images.read_text().splitlines() if not line.startswith("#"))
            words = first.split()
            words[1:6] = [*words[1:5], "nan"] if "NaN" in kind else ["0", "0", "0", "0", words[5]]
            images.write_text("\n".join([" ".join(words), *rest]))
        case "text: unknown camera":
            images.write_text(images.read_text().replace("3 cam02.png", "77 cam02.png"))
        case "text: a parameter is missing":
            path.write_text(path.read_text().replace(" 0 0 0\n", " 0 0\n", 1))
        case "text: too many images":
            line = images.read_text().splitlines()[4]
            images.write_text("\n\n".join([line] * 1100))
        case "toml: broken":
            path.write_text("[cam_0\n")
        case "toml: NaN rotation and a missing matrix":
            text = path.read_text().replace("rotation = [", "rotation = [nan, ", 1)
            path.write_text(text.replace("matrix", "motrix", 2).replace("motrix", "matrix", 1))
        case "toml: a fisheye of five coefficients":
            path.write_text(path.read_text().replace('name = "cam01"', 'name = "cam01"\nfisheye = true'))
    return path


FAULTS = {
    "binary: truncated cameras": ["promises|truncated"],
    "binary: truncated images": ["truncated"],
    "binary: empty": ["truncated"],
    "binary: a huge count": ["states 1152921504606846976"],
    "binary: a huge count of points": ["states 4611686018427387904"],
    "binary: NaN focal length": ["cam00.intrinsics.fx"],
    "binary: fisheye": ["number 7"],
    "binary: no images file": ["is missing: copy all files of the model"],
    "text: NaN translation": ["cam00.camera_from_world.translation"],
    "text: zero quaternion": ["cam00.camera_from_world.rotation"],
    "text: unknown camera": ["'cam02' names camera 77"],
    "text: a parameter is missing": ["has 11 parameters"],
    "text: too many images": ["images; a rig has at most"],
    "toml: broken": ["cannot be understood"],
    "toml: NaN rotation and a missing matrix": ["matrix is missing", "rotation"],
    "toml: a fisheye of five coefficients": [r"cam01.distortions must be at most 4 coefficients \(k1 k2 k3 k4\)"],
}


@pytest.mark.parametrize("kind", FAULTS)
def test_each_fault_is_named(kind: str, tmp_path: Path) -> None:
    path = corrupted(kind, tmp_path)
    for expected in FAULTS[kind]:
        with pytest.raises(InputError, match=expected):
            read_rig_file(path)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from([kind for kind in NAMES if kind not in ("eigenhead", "blender")]),
    which=st.integers(0, 1),
    cut=st.integers(0, 2000),
    at=st.integers(0, 2000),
    patch=st.binary(max_size=12),
)
def test_no_damage_escapes_as_another_error(
    kind: str, which: int, cut: int, at: int, patch: bytes, tmp_path: Path
) -> None:
    folder = tmp_path / kind
    write_rig_file(square(fan(3)), folder / NAMES[kind], kind)
    write_blanks(fan(3), folder)
    path = find_cameras(folder)
    damaged = path.with_name(path.name.replace("cameras", "images")) if which and "colmap" in kind else path
    if which and kind == "opencv-yaml":
        damaged = path.with_name("extri.yml")
    data = damaged.read_bytes()
    data = data[:at] + patch + data[at + len(patch) :]
    damaged.write_bytes(data[: len(data) - cut] if cut < len(data) // 2 else data)
    try:
        rig = read_rig_file(path)
    except InputError:
        return
    assert all(np.isfinite(camera.camera_from_world.rotation).all() for camera in rig)
