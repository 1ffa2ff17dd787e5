"""What users of foreign programs ran into: fisheye flags, cameras that are off, groups, dots, blank lines."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from rig.camera import Distortion
from rig.errors import InputError
from rig.formats.cameras.cameras_file import read_cameras, write_rig_file
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from tests.support.changed_rigs import relensed
from tests.support.fan_rig import fan
from tests.support.planted_keys import base


@pytest.mark.parametrize("place", ["top", "frame"])
def test_instant_ngp_says_a_fisheye_by_its_flag(place: str, tmp_path: Path) -> None:
    lens = RecordedLens("kannala-brandt", (0.02, -0.01, 0.003, 1e-3))
    straight = relensed(fan(3), lambda k: replace(k, distortion=Distortion()))
    rig = Rig(tuple(replace(camera, recorded=lens) for camera in straight))
    write_rig_file(rig, tmp_path / "transforms.json", "nerfstudio")
    document = json.loads((tmp_path / "transforms.json").read_text())
    del document["camera_model"]
    for frame in document["frames"]:
        del frame["camera_model"]
        if place == "frame":
            frame["is_fisheye"] = True
    (tmp_path / "transforms.json").write_text(json.dumps(document | ({"is_fisheye": True} if place == "top" else {})))
    back = read_cameras(tmp_path / "transforms.json").rig
    assert [camera.recorded for camera in back] == [camera.recorded for camera in rig]
    document["camera_model"], document["is_fisheye"] = "OPENCV", True
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="is_fisheye is true, and camera_model is OPENCV"):
        read_cameras(tmp_path / "transforms.json")


def test_a_fisheye_with_what_its_model_has_not_is_refused(tmp_path: Path) -> None:
    path = base("nerfstudio", tmp_path)
    document = json.loads(path.read_text())
    document["frames"] = [
        {**frame, "camera_model": "OPENCV_FISHEYE", "k3": 0, "p1": 0.001, "p2": 0} for frame in document["frames"]
    ]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="cam00: p1 is not 0, but a fisheye has only k1, k2, k3, k4"):
        read_cameras(path)


def metashape(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    path = tmp_path / "cameras.xml"
    write_rig_file(fan(5), path, "metashape")
    text = path.read_text()
    for old, new in changes:
        assert re.search(old, text, flags=re.DOTALL), old
        text = re.sub(old, new, text, flags=re.DOTALL)
    path.write_text(text)
    return path


@pytest.mark.parametrize("word", ["false", "0", "False"])
def test_a_camera_that_is_switched_off_takes_no_part_and_is_told(word: str, tmp_path: Path) -> None:
    read = read_cameras(metashape(tmp_path, (r'label="(cam0[13])">', rf'label="\1" enabled="{word}">')))
    assert read.rig.names == ("cam00", "cam02", "cam04")
    (remark,) = read.remarks
    assert remark.code == "view-left-out"
    assert ': cam01, cam03 switched off (enabled="false") in cameras.xml' in remark.text
    with pytest.raises(InputError, match="enabled is 'perhaps', wanted true or false"):
        read_cameras(metashape(tmp_path, ('label="cam01">', 'label="cam01" enabled="perhaps">')))


def test_cameras_that_are_not_aligned_are_told(tmp_path: Path) -> None:
    read = read_cameras(metashape(tmp_path, (r'(label="cam02">)\s*<transform>[^<]*</transform>', r"\1")))
    assert list(read.left_out) == ["cam02"]
    assert "cam02 not aligned in cameras.xml" in read.remarks[0].text


def test_a_dot_in_a_label_belongs_to_the_name_and_labels_that_repeat_take_their_groups(tmp_path: Path) -> None:
    read = read_cameras(metashape(tmp_path, (r'label="cam(\d\d)">', r'label="2024.11.25_cam.\1">')))
    assert read.rig.names[0] == "2024.11.25_cam.00"
    read = read_cameras(metashape(tmp_path, (r'label="cam(\d\d)">', r'label="shots\\\\cam.\1.TIF">')))
    assert read.rig.names[0] == "cam.00"
    grouped = (
        r'(<camera id="(\d+)" sensor_id="\d+" label=")(cam\d\d)(".*?</camera>)',
        r'<group id="\2" label="\3" type="folder">\1IMG_0001\4</group>',
    )
    assert read_cameras(metashape(tmp_path, grouped)).rig.names == fan(5).names


def test_slaves_of_a_rig_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_cameras(metashape(tmp_path, (r'<sensor id="([1-9])"', r'<sensor id="\1" master_id="0"')))
    (fault,) = refused.value.faults
    assert "4 cameras (cam01, cam02, cam03, cam04): sensor@master_id is '0': the sensor is a slave of" in fault.text
    read_cameras(metashape(tmp_path, (r'<sensor id="([1-9])"', r'<sensor id="\1" master_id="\1"')))  # their own


def test_cameras_of_two_components_are_refused(tmp_path: Path) -> None:
    two = '<components><component id="0"/><component id="1"/></components><cameras'
    apart = ((r"<cameras", two), (r'label="cam0([01])">', r'label="cam0\1" component_id="\1">'))
    with pytest.raises(InputError, match="the relative pose of cameras"):
        read_cameras(metashape(tmp_path, *apart))


def test_two_chunks_are_refused_and_an_empty_one_is_passed_over(tmp_path: Path) -> None:
    empty = read_cameras(metashape(tmp_path, ("<chunk ", '<chunk label="trial"><cameras/></chunk><chunk ')))
    assert len(empty.rig) == 5


@pytest.mark.parametrize("kind", ["nerfstudio", "colmap"])
def test_dots_in_names_of_pictures_belong_to_the_name(kind: str, tmp_path: Path) -> None:
    path = base(kind, tmp_path)
    target = path if kind == "nerfstudio" else path.with_name("images.txt")
    target.write_text(re.sub(r"(images/)?cam(\d\d)\.png", r"shot.0001.cam\2.tif", target.read_text()))
    assert read_cameras(path).rig.names == tuple(f"shot.0001.cam{i:02}" for i in range(4))


def test_names_that_repeat_take_the_innermost_folder_that_tells_them_apart(tmp_path: Path) -> None:
    path = base("nerfstudio", tmp_path)
    path.write_text(re.sub(r"images/(cam\d\d)\.png", r"images/\1/rgb/0001.png", path.read_text()))
    assert read_cameras(path).rig.names == fan(4).names


@pytest.mark.parametrize(("listed", "moment"), [(None, 3), ([7, 3], 7)])
def test_of_several_moments_one_is_read(listed: list[int] | None, moment: int, tmp_path: Path) -> None:
    path = base("nerfstudio", tmp_path)
    document = json.loads(path.read_text()) | ({} if listed is None else {"timestep_indices": listed})
    document["frames"] = [
        frame | {"file_path": f"images/{number}_{frame['file_path'][-9:]}", "timestep_index": number}
        for number in (7, 3)
        for frame in document["frames"]
    ]
    path.write_text(json.dumps(document))
    read = read_cameras(path)
    assert read.rig.names == tuple(f"{moment}_cam{i:02}" for i in range(4))
    assert list(read.left_out) == [f"{10 - moment}_cam{i:02}" for i in range(4)]
    assert f"of another moment than timestep_index {moment} (moments: 3, 7;" in read.remarks[-1].text


BLANK = ["as it is", "none", "two", "a comment between", "points in some"]


@pytest.mark.parametrize("way", BLANK)
def test_every_image_of_a_colmap_text_is_read(way: str, tmp_path: Path) -> None:
    path = base("colmap", tmp_path)
    images = path.with_name("images.txt")
    lines = [line for line in images.read_text().splitlines() if line.strip() and not line.startswith("#")]
    text = {
        "as it is": images.read_text(),
        "none": "\n".join(lines),
        "two": "\n\n\n".join(lines),
        "a comment between": "\n# its points\n\n".join(lines),
        "points in some": "\n".join([lines[0], "1 2 -1 3 4 5", lines[1], lines[2], "", lines[3]]),
    }[way]
    images.write_text(text + "\n")
    assert read_cameras(path).rig.names == fan(4).names
