"""What programs put beside pictures is read, or named: names in any case, encodings by their marks, other programs."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig.camera import Camera, Distortion
from rig.errors import InputError
from rig.formats.cameras.cameras_file import find_rig_file, read_cameras, rig_files, write_rig_file
from rig.formats.cameras.foreign import program_of
from rig.formats.captures.capture_folder import read_capture, unread_files, write_capture
from rig.formats.captures.shot_files import find_files
from rig.formats.pictures.picture_names import entry, match_names, safe_name
from rig.rig import Rig
from tests.support.fan_rig import fan, find_cameras
from tests.support.small_captures import small_capture, small_rig

FILES = {
    "eigenhead": "cameras.json", "metashape": "cameras.xml", "aniposelib": "calibration.toml",
    "caliscope": "camera_array.toml", "nerfstudio": "transforms.json",
}  # fmt: skip
MARKED = ("utf-8-sig", "utf-16", "utf-32")
MODELS = ("eigenhead", "colmap", "colmap-text", "caliscope", "aniposelib", "metashape", "nerfstudio", "opencv-yaml")


def close(one: Rig, two: Rig) -> None:
    assert one.names == two.names
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.centre_world, b.centre_world, atol=1e-6)


@pytest.mark.parametrize("kind", MODELS)
def test_names_in_capitals_are_read(kind: str, tmp_path: Path) -> None:
    place = tmp_path / "small"
    inner = place / "sparse" / "0" if kind.startswith("colmap") else place
    write_rig_file(fan(), inner / FILES.get(kind, "") if kind in FILES else inner, kind)
    for path in sorted(place.rglob("*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(path.name.upper()))
    close(read_cameras(find_cameras(place)).rig, fan())


def test_cameras_json_is_read_by_its_content_and_a_broken_link_is_named(tmp_path: Path) -> None:
    write_rig_file(fan(), file := tmp_path / "cameras.json", "metashape")
    close(read_cameras(find_cameras(tmp_path)).rig, fan())
    file.unlink()
    file.symlink_to("elsewhere.json")
    with pytest.raises(InputError, match=r"a link to a file that is not there: elsewhere\.json"):
        read_cameras(find_cameras(tmp_path))


@pytest.mark.parametrize("encoding", MARKED)
@pytest.mark.parametrize("kind", FILES)
def test_encodings_are_told_by_their_marks(kind: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / FILES[kind]
    write_rig_file(fan(), path, kind)
    text = path.read_text().replace('encoding="UTF-8"', 'encoding="UTF-16"').replace("encoding='UTF-8'", "")
    path.write_bytes(text.encode(encoding))
    assert find_rig_file(tmp_path) == path
    close(read_cameras(path).rig, fan())


def test_two_names_that_differ_in_case_alone_are_refused(tmp_path: Path) -> None:
    for name in ("Cameras.json", "cameras.JSON"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="differ in capitals alone"):
        list(rig_files(tmp_path))


@pytest.mark.parametrize(
    ("small", "called"),
    [
        ("images", "Images"), ("images", "IMAGES"), ("background", "Background"), ("masks", "MASKS"),
        ("cameras.json", "CAMERAS.JSON"), ("features.json", "Features.JSON"),
    ],
)  # fmt: skip
def test_a_capture_s_folders_are_found_in_any_case(small: str, called: str, tmp_path: Path) -> None:
    write_capture(tmp_path, small_capture(), small_rig())
    wanted = read_capture(tmp_path)[0]
    (tmp_path / small).rename(tmp_path / called)
    found = read_capture(tmp_path)[0]
    assert (found.images.keys(), found.masks.keys()) == (wanted.images.keys(), wanted.masks.keys())
    assert (found.backgrounds.keys(), found.features.keys()) == (wanted.backgrounds.keys(), wanted.features.keys())
    assert entry(tmp_path, small).name == called


@pytest.mark.parametrize(
    ("file", "text", "program"),
    [
        ("camchain.yaml", "cam0:\n  distortion_model: radtan\n", "Kalibr"),
        ("Camchain-imucam.YAML", "cam1:\n  T_cn_cnm1:\n", "Kalibr"),
        ("calibration.json", '{"Calibration": {"cameras": []}}', "calib.io"),
        ("calib.json", '{"libCalib": 1}', "calib.io"),
        ("blocks.xml", '<?xml version="1.0"?><BlocksExchange version="2.1"/>', "BlocksExchange"),
        ("cameras.opk", "x", "omega, phi, kappa"), ("CAMERAS.OPK", "x", "omega, phi, kappa"),
        ("shot.chan", "1 0 0 0", "Nuke"), ("scene.sfm", "{}", "Meshroom"), ("cameras.SFM", "{}", "Meshroom"),
        ("sfm_data.json", "{}", "OpenMVG"), ("reconstruction.json", '{"sfm_data_version": "0.3"}', "OpenMVG"),
        ("camera.json", '{"intrinsic_matrix": [1]}', "Open3D"),
        ("Transforms_Train.json", "{}", "transforms.json in parts"), ("poses_bounds.npy", "x", "LLFF"),
        ("cameras_sphere.npz", "x", "NeuS"), ("bundle.rd.out", "x", "Bundler"), ("model.NVM", "x", "VisualSFM"),
        ("project.psx", "x", "Metashape"), ("project.rcproj", "x", "RealityCapture"),
        ("rig.fbx", "x", "FBX"), ("cameras.abc", "x", "Alembic"),
        ("stereo.mat", "x", "MATLAB"), ("a.p4d", "x", "Pix4D"),
        ("stereo.yml", "%YAML:1.0\nM1: 1\n", "OpenCV"), ("a.qca.txt", "x", "Qualisys"), ("a.xcp", "x", "Vicon"),
        ("calibration.json", '{"distCoef": 1}', "Panoptic"), ("a.json", '{"camera_poses": {}}', "MultiCal"),
    ],
)  # fmt: skip
def test_the_program_of_a_file_that_is_not_read_is_named(file: str, text: str, program: str, tmp_path: Path) -> None:
    (tmp_path / file).write_bytes(text.encode())
    assert program in (program_of(tmp_path / file) or "")
    (remark,) = unread_files(tmp_path, [])
    assert (file in remark.text, program in remark.text) == (True, True)
    if not file.endswith(".out"):
        with pytest.raises(InputError, match=program):
            read_cameras(tmp_path / file)


def test_any_other_file_beside_photographs_is_named_too(tmp_path: Path) -> None:
    for name in ("studio.txt", "rig.vcal", "notes.md", "cam00.png", "Thumbs.db", "scale.json"):
        (tmp_path / name).write_text("cam00 1 2 3\n")
    (remark,) = unread_files(tmp_path, [])
    assert ": rig.vcal, studio.txt: not read" in remark.text


@pytest.mark.parametrize("name", ["cameras (1).json", "cameras.json.txt", "Rig.JSON"])
def test_our_cameras_are_read_by_their_content_under_another_name(name: str, tmp_path: Path) -> None:
    write_capture(tmp_path, small_capture(), small_rig())
    assert [*rig_files(tmp_path)] == [tmp_path / "cameras.json"]
    (tmp_path / "cameras.json").rename(tmp_path / name)
    capture, rig = read_capture(tmp_path)
    close(rig, small_rig())
    assert name in capture.digests


def test_pictures_of_rare_endings_are_read_and_folders_of_plates_named(tmp_path: Path) -> None:
    write_capture(tmp_path, small_capture(), small_rig())
    one, two, *_ = sorted((tmp_path / "images").iterdir())
    one.rename(one.with_suffix(".jfif"))
    shutil.copytree(tmp_path / "images", tmp_path / "clean_plates" / "front")
    capture, _ = read_capture(tmp_path)
    assert (one.stem in capture.images, [": clean_plates/ is" in r.text for r in capture.remarks]) == (True, [True])
    two.rename(two.with_suffix(""))
    with pytest.raises(InputError, match=f"images/{two.stem} is not read: endingless files"):
        read_capture(tmp_path)


@pytest.mark.parametrize(("file", "said"), [("intri.yml", "%YAML:1.0\nK_a: 1\n"), ("x.nvm", "NVM_V3")])
def test_cameras_in_a_folder_where_none_are_read_are_named(file: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib" / file).write_text(said)
    (remark,) = unread_files(tmp_path, [])
    assert file in remark.text


def test_a_camera_without_a_pose_takes_no_part(tmp_path: Path) -> None:
    write_rig_file(fan(4), tmp_path / "cameras.json", "eigenhead")
    document = json.loads((tmp_path / "cameras.json").read_text())
    document["cameras"][1].pop("camera_from_world")
    (tmp_path / "cameras.json").write_text(json.dumps(document))
    read = read_cameras(tmp_path / "cameras.json")
    assert [*read.rig.names, *read.left_out] == [fan(4).names[i] for i in (0, 2, 3, 1)]
    assert "without a pose" in read.remarks[0].text


def test_gaussian_splatting_s_cameras_are_read(tmp_path: Path) -> None:
    entries = []
    for number, camera in enumerate(fan()):
        k = camera.intrinsics
        place = {"position": (camera.centre_world / 1000.0).tolist()}
        place["rotation"] = camera.camera_from_world.rotation.T.tolist()
        lens = {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy}
        entries.append({"id": number, "img_name": camera.name, **lens, **place})
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    close(read_cameras(tmp_path / "cameras.json").rig, fan())


def test_nersemble_s_cameras_are_read(tmp_path: Path) -> None:
    lens = replace(small_rig()["a"].intrinsics, distortion=Distortion())
    poses_known = zip("abc", fan(3), strict=True)
    rig = Rig(tuple(Camera(name, lens, camera.camera_from_world) for name, camera in poses_known))
    write_capture(tmp_path, small_capture(), small_rig())
    poses = {}
    for camera in rig:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.camera_from_world.rotation, camera.camera_from_world.translation / 1000.0
        poses[camera.name] = matrix.tolist()
    document = {"world_2_cam": poses, "intrinsics": lens.matrix().tolist()}
    (tmp_path / "cameras.json").unlink()
    (tmp_path / "camera_params.json").write_text(json.dumps(document))
    close(read_cameras(find_cameras(tmp_path)).rig, rig)


def changed(tmp_path: Path, change: Callable[[dict], None]) -> Path:
    write_rig_file(fan(), tmp_path / "transforms.json", "nerfstudio")
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame in document["frames"]:
        change(frame)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    return tmp_path / "transforms.json"


def test_poses_of_three_rows_are_read_and_cameras_without_one_take_no_part(tmp_path: Path) -> None:
    path = changed(tmp_path, lambda frame: frame.update(transform_matrix=frame["transform_matrix"][:3]))
    close(read_cameras(path).rig, fan())
    path = changed(tmp_path, lambda frame: frame.pop("transform_matrix") if "cam02" in frame["file_path"] else None)
    read = read_cameras(path)
    assert (read.rig.names, [*read.left_out]) == (("cam00", "cam01", "cam03", "cam04"), ["cam02"])


@pytest.mark.parametrize("away_m", [(547.5, 946.5, 345.1), (40.0, 0.0, 0.0), (-1e4, 3.0, 2.0)])
def test_metres_are_told_by_the_cameras_distances_from_each_other(away_m: tuple, tmp_path: Path) -> None:
    def move(frame: dict) -> None:
        for row, by in zip(frame["transform_matrix"], away_m, strict=False):
            row[3] += by

    rig = read_cameras(changed(tmp_path, move)).rig
    for camera, known in zip(rig, fan(), strict=True):
        np.testing.assert_allclose(camera.centre_world - 1000.0 * np.array(away_m), known.centre_world, atol=1e-4)


@pytest.mark.parametrize("kind", ["eigenhead", "colmap", "metashape", "nerfstudio"])
def test_more_than_sixty_four_cameras_are_thinned(kind: str, tmp_path: Path) -> None:
    path = tmp_path / FILES[kind] if kind in FILES else tmp_path
    write_rig_file(fan(94), path, kind)
    read = read_cameras(find_cameras(tmp_path))
    assert (len(read.rig), len(read.left_out)) == (64, 30)
    assert any("64 that stand well apart" in remark.text for remark in read.remarks)


def test_a_skew_is_kept_in_our_file_and_refused_where_it_would_be_lost(tmp_path: Path) -> None:
    write_rig_file(fan(), tmp_path / "cameras.xml", "metashape")
    text = (tmp_path / "cameras.xml").read_text()
    (tmp_path / "cameras.xml").write_text(text.replace("<k1>", "<b2>-4.7</b2><k1>"))
    rig = read_cameras(tmp_path / "cameras.xml").rig
    write_rig_file(rig, tmp_path / "out.json", "eigenhead")
    for one, two in zip(rig, read_cameras(tmp_path / "out.json").rig, strict=True):
        assert one.recorded == two.recorded
        assert one.recorded is not None
        k = one.intrinsics
        at = np.array([[k.cx, k.cy + 100.0]])
        shifted = one.recorded.distorted(at, k.matrix()) - fan()[one.name].project(
            one.camera_from_world.inverse().apply(np.array([[0.0, 100.0 / k.fy, 1.0]]))
        )
        np.testing.assert_allclose(shifted[0], [-4.7 * 100.0 / k.fy, 0.0], atol=0.01)
    with pytest.raises(InputError, match="cannot hold the skew"):
        write_rig_file(rig, tmp_path / "sparse", "colmap")


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("Kamera 1", "Kamera_1"), ("cam[2]", "cam_2"), ("cam (3)", "cam_3"), ("Müller", "Muller"), ("é", "e"),
        ("頭", "u982d"), ("cam00", "cam00"), ("a+b", "a_b"), ("Links #4", "Links_4"), ("cam\u00a05", "cam_5"),
        ("../etc", "../etc"), (".hidden", ".hidden"),
    ],
)  # fmt: skip
def test_camera_names_are_mapped_to_letters_digits_and_signs(name: str, wanted: str) -> None:
    assert safe_name(name) == wanted
    if "/" not in name and not name.startswith("."):
        assert match_names([f"{name}.png"], [wanted]) in ({}, {wanted: [f"{name}.png"]})


@pytest.mark.parametrize("name", ["Kamera links", "cam[0]", "Gesicht (vorn)", "Schläfe", "頭"])
def test_a_capture_with_such_names_is_read(name: str, tmp_path: Path) -> None:
    write_capture(tmp_path, small_capture(), small_rig())
    for path in [*tmp_path.rglob("a.*"), *tmp_path.rglob("a")]:
        path.rename(path.with_name(name + path.suffix))
    document = json.loads((tmp_path / "cameras.json").read_text())
    document["cameras"][0]["name"] = name
    (tmp_path / "cameras.json").write_text(json.dumps(document))
    (tmp_path / "features.json").unlink()
    capture, rig = read_capture(tmp_path)
    assert rig.names == (safe_name(name), "b", "c")
    assert capture.images.keys() == {*rig.names}


def test_of_a_picture_taken_twice_the_raw_file_is_read(tmp_path: Path) -> None:
    write_capture(tmp_path, small_capture(), small_rig())
    (tmp_path / "images" / "a.DNG").write_bytes(b"raw")
    files = find_files(tmp_path, small_rig())
    assert (files.images["a"].name, files.strays, files.faults) == ("a.DNG", (), ())
