"""Data sets of a small simulated capture, read by readers that know only the formats' documentation: points of the
world lie in the pictures where the files say, to 0.01 px."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from server.cli.main import app
from tests.support.dataset_readers import (
    avatar_pixel,
    dot_centre,
    frames_of,
    moments_of,
    nerfstudio_pixel,
    read_png,
    with_dots,
)
from tests.support.made_up_flame import flame_surface, made_up_flame, some_parameters
from tests.support.result_folders import write_head
from tests.support.scenes import ellipsoid
from tests.support.small_studio import small_studio_captures
from tests.support.textured_wedge import HEIGHT, WIDTH, wedge_rig, write_photographs

pytestmark = pytest.mark.gl
Shot = tuple[Path, np.ndarray]
OFFSETS_MM = np.array([(0, 0, 0), (0, 62, 0), (0, -60, 0)], float)


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory, renderer: Renderer) -> Shot:
    """A capture with plates, and points (mm) inside the head that every picture shows as dots."""
    folder = small_studio_captures(tmp_path_factory.mktemp("shots"), 1, renderer, first=2) / "s2"  # all are usable
    capture, rig = read_capture(folder)
    points = rig.centre_world() + OFFSETS_MM
    images = {camera.name: with_dots(capture.images[camera.name], camera, points) for camera in rig}
    write_capture(folder, replace(capture, images=images), rig)
    return folder, points


def exported(shot: Path, out: Path, form: str, *options: str) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["export", str(shot), "--as", form, "--out", str(out), "--json", *options])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.fixture(scope="module", params=[("nerfstudio", nerfstudio_pixel), ("gaussian-avatars", avatar_pixel)])
def made(
    request: pytest.FixtureRequest, shot: Shot, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Callable[[dict[str, Any], np.ndarray], np.ndarray]]:
    form, project = request.param
    out = tmp_path_factory.mktemp(form)
    exported(shot[0], out, form)
    return out, project


def test_points_lie_in_the_pictures_where_the_files_say(made, shot: Shot) -> None:
    (out, project), (_, points) = made, shot
    errors = []
    for frame in frames_of(out):
        picture = read_png(out / frame["file_path"])
        assert picture.shape == (frame["h"], frame["w"], 3)
        for point in points:
            pixel = project(frame, point / 1000.0)
            errors.append(np.hypot(*(dot_centre(picture, pixel) - pixel)))
    assert len(errors) == 6 * len(points)
    assert max(errors) < 0.01
    assert json.loads((out / "transforms.json").read_text())["unit"] == "metre"


def test_masks_have_the_pictures_names_and_show_the_subject(made) -> None:
    out, _ = made
    for frame in frames_of(out):
        mask = read_png(out / frame["mask_path"])
        assert Path(frame["mask_path"]).name == Path(frame["file_path"]).name
        assert mask.shape == (frame["h"], frame["w"])
        assert 0.05 < (mask > 127).mean() < 0.6
        assert mask[frame["h"] // 2, frame["w"] // 2] == 255
        assert mask[2, 2] == 0


def test_avatars_come_before_white_in_divisions_that_share_no_camera(shot, tmp_path: Path) -> None:
    exported(shot[0], tmp_path, "gaussian-avatars")
    divisions = {end: frames_of(tmp_path, f"transforms_{end}.json") for end in ("train", "val", "test")}
    frames = frames_of(tmp_path)
    cameras = {end: {frame["camera_index"] for frame in part} for end, part in divisions.items()}
    assert cameras["train"] | cameras["val"] == {frame["camera_index"] for frame in frames} == set(range(6))
    assert not cameras["train"] & cameras["val"]
    assert cameras["val"] == cameras["test"]
    for frame in frames:
        assert {"cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x", "camera_angle_y"} <= frame.keys()
        assert frame["timestep_index"] == 0
        assert frame["fl_x"] == frame["fl_y"]
        assert (frame["cx"], frame["cy"]) == (frame["w"] / 2, frame["h"] / 2)
        picture, mask = read_png(tmp_path / frame["file_path"]), read_png(tmp_path / frame["fg_mask_path"])
        assert (picture[mask == 0] == 255).all()
        assert (picture[mask == 255] < 255).any()


@pytest.mark.parametrize("form", ["nerfstudio", "gaussian-avatars"])
def test_a_results_head_becomes_the_point_cloud_in_the_same_frame(shot: Shot, tmp_path: Path, form: str) -> None:
    capture, rig = read_capture(shot[0])
    head = ellipsoid(2)
    count = len(head.vertices)
    mesh = Mesh(head.vertices + rig.centre_world(), head.faces)
    result = tmp_path / "result"
    colours = np.arange(3 * count).reshape(count, 3).astype(np.uint8)
    write_head(result, mesh, colours=colours)
    (result / "report.json").write_text(json.dumps({"inputs": dict(capture.digests)}))
    answer = exported(shot[0], tmp_path / "out", form, "--result", str(result))
    assert answer["points"] == count
    file = json.loads((tmp_path / "out/transforms.json").read_text())["ply_file_path"]
    assert file == {"nerfstudio": "sparse_pc.ply", "gaussian-avatars": "points3d.ply"}[form]
    header, _, body = (tmp_path / "out" / file).read_bytes().partition(b"end_header\n")
    assert f"element vertex {count}\n".encode() in header
    record = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in "rgb"])
    points = np.frombuffer(body, record)
    np.testing.assert_allclose(np.stack([points[axis] for axis in "xyz"], 1) * 1000.0, mesh.vertices, atol=1e-3)
    assert (np.stack([points[channel] for channel in "rgb"], 1) == colours).all()


def test_flame_parameters_of_a_result_make_its_head_where_the_pictures_show_it(shot: Shot, tmp_path: Path) -> None:
    """Read as GaussianAvatars' loader does: a file of parameters a moment, named by frames, and a canonical one."""
    capture, _ = read_capture(shot[0])
    arrays, parameters, result = made_up_flame(), some_parameters(), tmp_path / "result"
    offsets = np.random.default_rng(5).normal(0.0, 1e-3, arrays["v_template"].shape)
    parameters |= {"static_offset": offsets[None]}
    write_head(result, ellipsoid(2))
    (result / "report.json").write_text(json.dumps({"inputs": dict(capture.digests)}))
    single: dict[str, Any] = {name: array.astype(np.float32) for name, array in parameters.items()}
    np.savez(result / "flame_param.npz", **single)
    assert exported(shot[0], tmp_path / "out", "gaussian-avatars", "--result", str(result))["flame"]
    moments = moments_of(tmp_path / "out")
    assert list(moments) == [0]
    np.testing.assert_allclose(flame_surface(arrays, moments[0]), flame_surface(arrays, parameters), atol=1e-5)
    at_rest = {name: 0.0 * array for name, array in parameters.items()} | {"jaw_pose": np.array([[0.3, 0.0, 0.0]])}
    at_rest |= {"shape": parameters["shape"], "static_offset": parameters["static_offset"]}
    with np.load(tmp_path / "out/canonical_flame_param.npz", allow_pickle=False) as file:
        np.testing.assert_allclose(flame_surface(arrays, dict(file)), flame_surface(arrays, at_rest), atol=1e-6)
    exported(shot[0], tmp_path / "out", "gaussian-avatars", "--overwrite")
    assert not (tmp_path / "out/canonical_flame_param.npz").exists()
    assert not moments_of(tmp_path / "out")
    (result / "flame_param.npz").write_bytes(b"no archive")
    arguments = ["export", str(shot[0]), "--as", "gaussian-avatars", "--out", str(tmp_path / "bad"), "--result"]
    assert "damaged" in str(CliRunner().invoke(app, [*arguments, str(result)]).exception)


def test_a_result_of_another_capture_is_refused_by_its_files(shot: Shot, tmp_path: Path) -> None:
    capture, _ = read_capture(shot[0])
    write_head(tmp_path, ellipsoid(2))
    inputs = dict(capture.digests) | {"cameras.json": "ab" * 32}
    (tmp_path / "report.json").write_text(json.dumps({"inputs": inputs}))
    arguments = ["export", str(shot[0]), "--as", "nerfstudio", "--out", str(tmp_path / "out"), "--result"]
    refused = CliRunner().invoke(app, [*arguments, str(tmp_path)])
    assert refused.exit_code == 1
    assert "was made of another cameras.json than this capture has" in str(refused.exception)
    assert not (tmp_path / "out" / "transforms.json").exists()
    (tmp_path / "one").mkdir()
    shutil.copy(next((shot[0] / "images").iterdir()), tmp_path / "one")
    alone = CliRunner().invoke(app, ["export", str(tmp_path / "one"), *arguments[2:], str(tmp_path)])
    assert "at least 3 from different places" in str(alone.exception)
    assert not (tmp_path / "out" / "found").exists()
    (tmp_path / "report.json").unlink()
    assert "has no report.json" in str(CliRunner().invoke(app, [*arguments, str(tmp_path)]).exception)


def test_a_data_set_is_replaced_only_on_request(shot: Shot, tmp_path: Path) -> None:
    out = tmp_path / "out"
    exported(shot[0], out, "gaussian-avatars")
    again = ["export", str(shot[0]), "--as", "nerfstudio", "--out", str(out)]
    refused = CliRunner().invoke(app, again)
    assert "is there already" in str(refused.exception)
    exported(shot[0], out, "nerfstudio", "--overwrite")
    assert sorted(path.name for path in out.iterdir()) == ["images", "masks", "transforms.json"]
    assert len(list((out / "images").iterdir())) == 6
    assert "changes nothing in nerfstudio" in CliRunner().invoke(app, [*again, "--plane=frankfurt"]).output
    inside = CliRunner().invoke(app, ["export", str(shot[0]), "--as", "nerfstudio", "--out", str(shot[0] / "images")])
    assert "the capture's own pictures" in str(inside.exception)


@pytest.mark.slow
def test_photographs_alone_are_calibrated_once_and_keep_the_frame_of_their_result(tmp_path: Path) -> None:
    rig = wedge_rig()
    photographs = write_photographs(tmp_path / "photos", rig)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    for camera in rig:  # a ball before the wedge is the subject
        column, row = camera.project(np.array([[0.0, 0.0, -20.0]]))[0]
        disc = np.hypot(columns - column, rows - row) < 80
        write_image(photographs / "masks" / f"{camera.name}.png", disc.astype(np.uint8) * np.uint8(255))
    apart = np.linalg.norm(rig["cam00"].centre_world - rig["cam04"].centre_world)
    scale = {"cameras": ["cam00", "cam04"], "distance_mm": 1.5 * apart}  # makes the ball as large as a head
    (photographs / "scale.json").write_text(json.dumps(scale))
    settings = tmp_path / "settings.json"  # a front camera that no guess would choose: the world is another without it
    settings.write_text(json.dumps({"front": "cam04"}))
    exported(photographs, tmp_path / "first", "nerfstudio", "--settings", str(settings))
    found = tmp_path / "first" / "found"
    kept = {path.name: path.read_bytes() for path in found.glob("c*.json")}
    assert set(kept) == {"cameras.json", "calibration.json"}
    assert len(frames_of(tmp_path / "first")) == len(rig)

    result = tmp_path / "result"  # as a reconstruction leaves it: what was found, the head, and what it was made of
    shutil.copytree(found, result)
    write_head(result, ellipsoid(2))
    made_of = json.loads(kept["calibration.json"])
    inputs = {name: digest for name, digest in made_of["made_of"].items() if name.endswith(".png")}
    inputs |= {"cameras.json": made_of["cameras_sha256"]}
    (result / "report.json").write_text(json.dumps({"inputs": inputs}))
    exported(photographs, tmp_path / "second", "nerfstudio", "--result", str(result))
    for name, content in kept.items():
        assert (tmp_path / "second" / "found" / name).read_bytes() == content
        assert (result / name).read_bytes() == content
    first, second = (frames_of(tmp_path / folder) for folder in ("first", "second"))
    assert first == second
