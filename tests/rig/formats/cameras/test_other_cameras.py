"""Foreign rig files: what is written is read back the same, by us and by pycolmap; damage always ends in InputError."""

import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.camera import Distortion, Intrinsics
from rig.errors import InputError
from rig.formats.cameras.cameras_file import FORMATS, find_rig_file, read_rig_file, rig_file_parts, write_rig_file
from rig.formats.cameras.colmap import write_colmap
from rig.formats.cameras.opencv_yaml import write_aniposelib
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from tests.support.changed_rigs import relensed, reposed
from tests.support.fan_rig import NAMES, POINTS, fan, find_cameras, square, write_blanks
from tests.support.shared_data import shared


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_is_written_and_found_again(kind: str, tmp_path: Path) -> None:
    rig = square(fan()) if kind == "realitycapture-csv" else fan()
    write_rig_file(rig, tmp_path / NAMES[kind], kind)
    write_blanks(rig, tmp_path)
    (tmp_path / "board.toml").write_text('kind = "checkerboard"\n')  # no rig: must not be taken for one
    file = find_rig_file(tmp_path)
    assert (file is None) == (kind == "blender")
    if file is None:
        return
    back = read_rig_file(file)
    assert sorted(back.names) == sorted(rig.names)
    for camera in rig:
        np.testing.assert_allclose(back[camera.name].project(POINTS), camera.project(POINTS), atol=1e-6)
        assert back[camera.name].intrinsics.width == camera.intrinsics.width
    assert all(part.is_file() for part in rig_file_parts(file))
    if kind == "eigenhead":  # whatever its name
        assert rig_file_parts(file.rename(tmp_path / "cameras.txt")) == (tmp_path / "cameras.txt",)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("vectors", [True, False])
def test_opencv_matrices_in_one_file(unit: float, vectors: bool, tmp_path: Path) -> None:
    """As who calibrated with OpenCV writes K, dist, R and T by FileStorage, in mm or in metres."""
    rig = fan()
    file = cv2.FileStorage(str(tmp_path / "studio.yaml"), cv2.FILE_STORAGE_WRITE)
    for camera in rig:
        pose = camera.camera_from_world
        file.write(f"K_{camera.name}", camera.intrinsics.matrix())
        file.write(f"dist_{camera.name}", camera.intrinsics.distortion.opencv())
        file.write(f"R_{camera.name}", cv2.Rodrigues(pose.rotation)[0] if vectors else pose.rotation)
        file.write(f"T_{camera.name}", pose.translation / unit)
    file.release()
    write_blanks(rig, tmp_path)
    (tmp_path / "compose.yaml").write_text("services: {}\n")  # no rig, and before it by name
    assert find_rig_file(tmp_path) == tmp_path / "studio.yaml"
    back = read_rig_file(tmp_path / "studio.yaml")
    for camera in rig:
        np.testing.assert_allclose(back[camera.name].project(POINTS), camera.project(POINTS), atol=1e-6)


def test_an_unknown_format_and_a_yaml_of_opencv_without_cameras_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'ply' is not one of eigenhead, colmap"):
        write_rig_file(fan(), tmp_path / "x", "ply")
    (tmp_path / "board.yml").write_text("%YAML:1.0\n---\nsquare: 25.\n")
    with pytest.raises(InputError, match=r"board\.yml: .* no camera; expected K_<name>, dist_<name>, R_<name>"):
        read_rig_file(tmp_path / "board.yml")


def bent(lens: RecordedLens) -> Rig:
    """The fan with a foreign lens before every camera."""
    straight = relensed(fan(), lambda k: replace(k, distortion=Distortion()))
    return Rig(tuple(replace(camera, recorded=lens) for camera in straight))


FISHEYE = RecordedLens("kannala-brandt", (-0.02, 0.004, -0.001, 0.0002))
RATIONAL = RecordedLens("rational", (0.1, -0.02, 1e-3, -5e-4, 0.003, 0.2, 0.01, 0.001))


@pytest.mark.parametrize(
    ("lens", "kind"),
    [(FISHEYE, k) for k in ("eigenhead", "colmap", "colmap-text", "caliscope", "metashape", "nerfstudio")]
    + [(RATIONAL, k) for k in ("eigenhead", "colmap", "aniposelib", "opencv-yaml")],
)
def test_foreign_lenses_go_out_and_in(lens: RecordedLens, kind: str, tmp_path: Path) -> None:
    write_rig_file(bent(lens), tmp_path / NAMES[kind], kind)
    for camera in read_rig_file(find_cameras(tmp_path)):
        assert camera.recorded is not None
        assert camera.recorded.model == lens.model
        np.testing.assert_allclose(camera.recorded.coefficients, lens.coefficients, rtol=1e-12)
        np.testing.assert_allclose(camera.project(POINTS), bent(lens)[camera.name].project(POINTS), atol=1e-8)


@pytest.mark.parametrize(
    ("lens", "kind"),
    [(RATIONAL, "metashape"), (RATIONAL, "nerfstudio"), (FISHEYE, "opencv-yaml"), (FISHEYE, "realitycapture")],
)
def test_a_lens_that_a_format_does_not_have_is_refused(lens: RecordedLens, kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cam00"):
        write_rig_file(bent(lens), tmp_path / NAMES[kind], kind)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("lens", [None, FISHEYE, RATIONAL], ids=["OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_pycolmap_loads_and_bends_what_is_exported(lens: RecordedLens | None, binary: bool, tmp_path: Path) -> None:
    rig = fan() if lens is None else bent(lens)
    write_colmap(rig, tmp_path, binary=binary)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert len(model.images) == len(rig)
    for image in model.images.values():
        camera = rig[Path(image.name).stem]
        theirs = np.array([image.project_point(point) for point in POINTS]) - 0.5
        straight = camera.project(POINTS)
        ours = straight if lens is None else lens.distorted(straight, camera.intrinsics.matrix())
        np.testing.assert_allclose(theirs, ours, atol=1e-8 if lens is None else 1e-7)


def test_simple_colmap_models_and_folders_of_images(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(
        "# c\n1 SIMPLE_PINHOLE 640 480 700 320 240\n2 RADIAL 640 480 710 320 240 0.1 -0.2\n"
    )
    poses = "".join(f"{i} 1 0 0 0 {i} 0 900 {1 + i % 2} cam{i}/shot.jpg\n10.5 11.5 -1\n" for i in range(3))
    (tmp_path / "images.txt").write_text(poses)
    rig = read_rig_file(tmp_path / "cameras.txt")
    assert rig.names == ("cam0", "cam1", "cam2")
    assert rig["cam0"].intrinsics == Intrinsics(640, 480, 700.0, 700.0, 319.5, 239.5)
    assert rig["cam1"].intrinsics.distortion == Distortion(0.1, -0.2)


def test_the_published_caliscope_file(tmp_path: Path) -> None:
    rig = read_rig_file(shared("data/multicam-board/camera_array.toml"))
    assert rig.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    np.testing.assert_allclose(rig["cam_0"].camera_from_world.translation, [171.2599, -32.3454, 1208.3865], atol=1e-3)


@pytest.mark.parametrize(("unit", "scale"), [("", 1.0), ("", 1000.0), ('unit = "mm"', 1.0), ('unit = "m"', 1000.0)])
def test_the_unit_of_an_aniposelib_file(unit: str, scale: float, tmp_path: Path) -> None:
    rig, path = fan(3), tmp_path / "calibration.toml"
    write_aniposelib(reposed(rig, lambda pose: replace(pose, translation=pose.translation / scale)), path)
    path.write_text(path.read_text().replace('unit = "mm"', unit))
    back = read_rig_file(path)
    np.testing.assert_allclose(back["cam01"].camera_from_world.translation, rig["cam01"].camera_from_world.translation)


def test_opencv_yaml_of_plain_lists_is_read_and_words_in_place_of_numbers_are_named(tmp_path: Path) -> None:
    """As written by hand, or cut off within a matrix."""
    rig, path = fan(3), tmp_path / "studio.yml"
    lines = ["%YAML:1.0", "---"]
    for camera in rig:
        pose, name = camera.camera_from_world, camera.name
        rows = {f"K_{name}": camera.intrinsics.matrix(), f"Rot_{name}": pose.rotation}
        lines += [f"{key}: [{', '.join(str(row.tolist()) for row in matrix)}]" for key, matrix in rows.items()]
        lines += [f"dist_{name}: {camera.intrinsics.distortion.opencv().tolist()}"]
        lines += [f"T_{name}: {pose.translation.tolist()}"]
        lines += [f"W_{name}: {camera.intrinsics.width}", f"H_{name}: {camera.intrinsics.height}"]
    path.write_text("\n".join(lines) + "\n")
    back = read_rig_file(path)
    for camera in rig:
        np.testing.assert_allclose(back[camera.name].project(POINTS), camera.project(POINTS), atol=1e-6)
    words = [f"{line.split(':')[0]}: east" if line.startswith(("T_", "Rot_cam01")) else line for line in lines]
    path.write_text("\n".join(words) + "\n")
    with pytest.raises(InputError, match="T_cam00 is missing or no list of 3 numbers"):
        read_rig_file(path)


def test_a_csv_that_a_spreadsheet_saved_with_semicolons_is_read(tmp_path: Path) -> None:
    rig, path = square(fan()), tmp_path / "cameras.csv"
    write_blanks(rig, tmp_path)
    write_rig_file(rig, path, "realitycapture-csv")
    plain = read_rig_file(path)
    path.write_text("\ufeff" + path.read_text().replace(",", ";").replace(".", ",").replace(",png", ".png"), "utf-8")
    assert find_rig_file(tmp_path) == path
    saved = read_rig_file(path.rename(tmp_path / "cameras.json"))
    assert saved.names == plain.names
    for one, other in zip(saved, plain, strict=True):
        np.testing.assert_allclose(one.project(POINTS), other.project(POINTS))


Change = Callable[[bytes], bytes]
FAULTS: dict[str, tuple[str, str, Change, str]] = {
    "truncated cameras": ("colmap", "cameras", lambda data: data[:-30], "promises|truncated"),
    "truncated images": ("colmap", "images", lambda data: data[:-3], "truncated"),
    "empty": ("colmap", "cameras", lambda data: b"", "truncated"),
    "a huge count": ("colmap", "cameras", lambda data: struct.pack("<Q", 1 << 60) + data[8:], f"states {1 << 60}"),
    "a huge count of points": (
        "colmap", "images", lambda data: data[:-8] + struct.pack("<Q", 1 << 62), f"states {1 << 62}"
    ),
    "NaN focal length": (
        "colmap", "cameras", lambda data: data[:32] + struct.pack("<d", np.nan) + data[40:], "cam00.intrinsics.fx"
    ),
    "the model FOV": ("colmap", "cameras", lambda data: data[:12] + struct.pack("<i", 7) + data[16:], "number 7"),
    "NaN translation": (
        "colmap-text", "images", lambda data: re.sub(rb"(?m)^(1( \S+){4}) \S+", rb"\1 nan", data, count=1),
        "cam00.camera_from_world.translation",
    ),
    "zero quaternion": (
        "colmap-text", "images", lambda data: re.sub(rb"(?m)^1( \S+){4}", b"1 0 0 0 0", data, count=1),
        "cam00.camera_from_world.rotation",
    ),
    "unknown camera": (
        "colmap-text", "images", lambda data: data.replace(b"3 cam02.png", b"77 cam02.png"), "'cam02' names camera 77"
    ),
    "a parameter is missing": (
        "colmap-text", "cameras", lambda data: data.replace(b" 0 0 0\n", b" 0 0\n", 1), "has 11 lens parameters"
    ),
    "too many images": (
        "colmap-text", "images", lambda data: b"\n\n".join([data.splitlines()[4]] * 1100), "images; a rig has at most"
    ),
    "no TOML": ("aniposelib", "cameras", lambda data: b"[cam_0\n", "cannot be understood"),
    "NaN rotation": (
        "aniposelib", "cameras", lambda data: data.replace(b"rotation = [", b"rotation = [nan, ", 1), "rotation"
    ),
    "a missing matrix": (
        "aniposelib", "cameras", lambda data: data.replace(b"matrix", b"motrix", 1), "matrix is missing"
    ),
    "a fisheye of five coefficients": (
        "aniposelib", "cameras", lambda data: data.replace(b'name = "cam01"', b'name = "cam01"\nfisheye = true'),
        r"cam01.distortions must be at most 4 coefficients \(k1 k2 k3 k4\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("form", "file", "change", "words"), FAULTS.values(), ids=FAULTS)
def test_each_fault_is_named(form: str, file: str, change: Change, words: str, tmp_path: Path) -> None:
    write_rig_file(fan(), tmp_path / NAMES[form], form)
    path = find_cameras(tmp_path)
    damaged = path.with_name(path.name.replace("cameras", file))
    damaged.write_bytes(change(damaged.read_bytes()))
    with pytest.raises(InputError, match=words):
        read_rig_file(path)


def test_a_model_without_its_images_is_named(tmp_path: Path) -> None:
    write_rig_file(fan(), tmp_path, "colmap")
    (tmp_path / "images.bin").unlink()
    with pytest.raises(InputError, match="is missing: copy all files of the model"):
        read_rig_file(tmp_path / "cameras.bin")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from([kind for kind in NAMES if kind not in ("eigenhead", "blender")]),
    which=st.integers(0, 1),
    cut=st.integers(0, 2000),
    at=st.integers(0, 2000),
    patch=st.binary(max_size=12),
)
def test_no_damage_is_another_error(kind: str, which: int, cut: int, at: int, patch: bytes, tmp_path: Path) -> None:
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
