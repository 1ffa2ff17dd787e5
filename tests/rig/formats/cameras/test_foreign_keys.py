"""A row of the table of foreign keys each: what is read changes the rig, what is refused or told is named, the rest is
without effect. The page that shows the table holds just that."""

import csv
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from rig.camera import Distortion
from rig.errors import InputError
from rig.formats.cameras.cameras_file import find_rig_file, read_cameras, write_rig_file
from rig.formats.cameras.colmap import COLMAP_MODELS, REFUSED_MODELS
from rig.formats.cameras.foreign_keys import FOREIGN_KEYS, ForeignKey, markdown_table, says_nothing
from rig.formats.cameras.reading import CamerasRead
from rig.formats.cameras.unread_programs import OPENCV_KEYS, PATTERNS
from rig.formats.pictures.images import write_image
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from tests.rig.formats.cameras.test_other_cameras import NAMES, POINTS, fan, square

ROWS = [(kind, key) for kind, (_, table) in FOREIGN_KEYS.items() for key in table]
PAGE = Path(__file__).parents[4] / "docs" / "foreign-cameras.md"
Plant = Callable[[Path, str, object], None]


def base(kind: str, folder: Path) -> Path:
    """A capture's folder with a rig of that kind, complete enough for every key to have its place."""
    rig = square(fan(4)) if kind == "realitycapture-csv" else fan(4)
    written = "colmap-text" if kind == "colmap" else kind
    write_rig_file(rig, folder / NAMES[written], written)
    for camera in rig if kind.startswith("realitycapture") else ():  # which leave the size to the pictures
        pixels = np.zeros((camera.intrinsics.height, camera.intrinsics.width), np.uint8)
        write_image(folder / "images" / f"{camera.name}.png", pixels)
    if kind == "metashape":
        path = folder / "cameras.xml"
        tree = ElementTree.parse(path)
        chunk = tree.getroot().find("chunk")
        assert chunk is not None
        part = ElementTree.SubElement(ElementTree.SubElement(chunk, "components"), "component", id="0")
        world = chunk.find("transform")
        assert world is not None
        part.append(world)  # the chunk keeps its own
        cameras = chunk.find("cameras")
        assert cameras is not None
        group = ElementTree.SubElement(cameras, "group", id="0", label="left", type="folder")
        for camera in [*cameras.findall("camera")]:
            camera.set("component_id", "0")
            if camera.get("label") == "cam01":
                cameras.remove(camera)
                group.append(camera)
        tree.write(path)
    found = find_rig_file(folder)
    assert found is not None
    return found


def plant_xml(path: Path, key: str, value: object) -> None:
    """Into the second camera, its sensor, the one group, component or chunk."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    places = {
        "camera": ".//camera[@label='cam01']",
        "sensor": ".//sensor[@label='cam01']",
        "calibration": ".//sensor[@label='cam01']/calibration",
        "group": ".//group",
        "component": ".//component",
        "chunk": ".//chunk",
    }
    if key == "chunk":
        root.append(ElementTree.fromstring(ElementTree.tostring(root[0])))
    elif "@" in key:
        place, name = key.split("@")
        for node in root.iterfind(places[place]):
            node.set(name, str(value))
    else:
        place, name = key.split("/")
        node = root.find(places[place])
        assert node is not None
        attributes = {}
        if "[" in name:
            name, inner = name.rstrip("]").split("[")
            attributes = {"name": inner, "value": str(value)}
        for old in [*node.findall(name)] if not attributes else []:
            node.remove(old)
        if isinstance(value, str) and value.startswith("<"):
            node.append(ElementTree.fromstring(value))
        else:
            ElementTree.SubElement(node, name, attributes).text = None if attributes else str(value)
    tree.write(path)


def plant_xmp(path: Path, key: str, value: object) -> None:
    side = path.with_name("cam01.xmp")
    text = re.sub(rf'\s?xcr:{key}="[^"]*"|<xcr:{key}>[^<]*</xcr:{key}>', "", side.read_text())
    side.write_text(text.replace("</rdf:Description>", f"<xcr:{key}>{value}</xcr:{key}></rdf:Description>"))


def plant_csv(path: Path, key: str, value: object) -> None:
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    rows[1][key] = str(value)
    out = io.StringIO()
    writer = csv.DictWriter(out, rows[1], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    path.write_text(out.getvalue())


def plant_json(path: Path, key: str, value: object) -> None:
    document = json.loads(path.read_text())
    if key == "frames":
        document["frames"] = document["frames"][:3]
    elif key in ("applied_scale", "applied_transform"):
        document[key] = value
    else:
        if key.startswith("camera_angle"):
            del document["frames"][1]["fl_" + key[-1]]
        if key == "is_fisheye":
            del document["camera_model"]
        if key in ("k4", "k5"):
            document["frames"][1]["k3"] = 0
        document["frames"][1][key] = value
    path.write_text(json.dumps(document))


def plant_toml(path: Path, key: str, value: object) -> None:
    text = path.read_text()
    if key.startswith("metadata."):
        key = key.removeprefix("metadata.")
        text = re.sub(rf"(?m)^{key} = .*\n", "", text) + f"\n{key} = {json.dumps(value)}\n"
    else:
        head, name, block = re.split(r"(\[(?:cameras\.|cam_)1\]\n)", text)
        block, *rest = re.split(r"(?m)^(?=\[)", block, maxsplit=1)
        block = re.sub(rf"(?m)^{key} = .*\n", "", block) + ("" if value is None else f"{key} = {json.dumps(value)}\n")
        text = head + name + block + "".join(rest)
    path.write_text(text)


def plant_yaml(path: Path, key: str, value: object) -> None:
    target = path.with_name("extri.yml" if key.startswith(("R_", "Rot_", "T_")) else "intri.yml")
    text = target.read_text()
    name = key.replace("<name>", "cam01")
    text = re.sub(rf"(?ms)^{name}:.*?(?=^\w|\Z)", "", text)
    file = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if isinstance(value, list) and isinstance(value[0], str):
        file.startWriteStruct(name, cv2.FILE_NODE_SEQ)
        for word in value:
            file.write("", word)
        file.endWriteStruct()
    else:
        file.write(name, np.array(value, float) if isinstance(value, list) else value)  # type: ignore[arg-type]
    target.write_text(text + file.releaseAndGetString().split("---\n")[1])


def plant_colmap(path: Path, key: str, value: object) -> None:
    images = path.with_name("images.txt")
    lines = images.read_text().splitlines()
    if key in COLMAP_MODELS or key in REFUSED_MODELS.values():
        keys = COLMAP_MODELS[key][1] if key in COLMAP_MODELS else ("f",) * 4
        numbers = {"f": 1500, "fx": 1500, "fy": 1500, "cx": 512, "cy": 384}
        parameters = " ".join(str(numbers.get(name, 0.01)) for name in keys)
        path.write_text("".join(f"{i} {key} 1024 768 {parameters}\n" for i in range(1, 5)))
    elif key == "sparse/1":
        write_rig_file(fan(3), path.parents[1] / "1", "colmap-text")
    elif key in ("rigs.*", "frames.*", "points3D.*"):
        path.with_name(key.replace("*", "txt")).write_text("# not looked at\n1 2 3\n")
    elif key in ("CAMERA_ID", "WIDTH", "HEIGHT", "PARAMS[]"):
        words = path.read_text().splitlines()
        at = {"CAMERA_ID": 0, "WIDTH": 2, "HEIGHT": 3, "PARAMS[]": 4}[key]
        words[1] = " ".join(str(value) if i == at else word for i, word in enumerate(words[1].split()))
        path.write_text("\n".join(words))
    elif key == "POINTS2D[]":
        lines[5] = "1.5 2.5 -1 3.5 4.5 7"
        images.write_text("\n".join([line for line in lines if line.strip()]))
    else:
        at = {"IMAGE_ID": 0, "QW QX QY QZ": 4, "TX TY TZ": 5, "NAME": 9}[key]
        lines[4] = " ".join(str(value) if i == at else word for i, word in enumerate(lines[4].split()))
        images.write_text("\n".join(lines))


PLANTS: dict[str, Plant] = {
    "metashape": plant_xml,
    "realitycapture": plant_xmp,
    "realitycapture-csv": plant_csv,
    "colmap": plant_colmap,
    "nerfstudio": plant_json,
    "caliscope": plant_toml,
    "aniposelib": plant_toml,
    "opencv-yaml": plant_yaml,
}
TURNED = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
BIG = [[999, 0, 500], [0, 999, 400], [0, 0, 1]]
POSE = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
WORLD = "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>0 0 1</translation><scale>2</scale></transform>"
# A value that says something, where 7 does not, or says it of another kind.
VALUES: dict[tuple[str, str], object] = {
    ("metashape", "camera@label"): "other.JPG",
    ("metashape", "camera@enabled"): "false",
    ("metashape", "group@label"): "elsewhere",
    ("metashape", "sensor@type"): "fisheye",
    ("metashape", "calibration@class"): "initial",
    ("metashape", "calibration@type"): "fisheye",
    ("metashape", "calibration/b2"): 0.5,
    ("metashape", "calibration/k4"): 0.5,
    ("metashape", "calibration/p3"): 0.01,
    ("metashape", "calibration/p4"): 0.01,
    ("metashape", "chunk/transform"): WORLD,
    ("metashape", "component/transform"): WORLD,
    ("metashape", "camera/transform"): "1 0 0 0.1 0 1 0 0 0 0 1 -3 0 0 0 1",
    ("metashape", "sensor/resolution"): '<resolution width="900" height="700"/>',
    ("metashape", "calibration/resolution"): '<resolution width="900" height="700"/>',
    **{("metashape", f"calibration/{key}"): 0.5 for key in ("k1", "k2", "k3", "p1", "p2")},
    ("realitycapture", "Rotation"): "0 -1 0 1 0 0 0 0 1",
    ("realitycapture", "Position"): "0.1 0.2 3",
    ("realitycapture", "DistortionModel"): "division",
    ("realitycapture", "DistortionCoeficients"): "0.1 0 0 0 0 0",
    ("realitycapture", "InMeshing"): "0",
    ("realitycapture", "InTexturing"): "0",
    ("realitycapture", "InColoring"): "0",
    ("realitycapture", "PosePrior"): "initial",
    ("realitycapture", "Coordinates"): "relative",
    ("realitycapture", "ComponentId"): "{B}",
    ("realitycapture-csv", "#name"): "other.png",
    **{("realitycapture-csv", key): 0.3 for key in ("k1", "k2", "k3", "k4", "t1", "t2")},
    ("colmap", "NAME"): "other.png",
    ("nerfstudio", "camera_model"): "OPENCV_FISHEYE",
    ("nerfstudio", "is_fisheye"): True,
    ("nerfstudio", "camera_angle_x"): 0.5,
    ("nerfstudio", "camera_angle_y"): 0.5,
    ("nerfstudio", "file_path"): "images/other.png",
    ("nerfstudio", "transform_matrix"): POSE,
    ("nerfstudio", "applied_scale"): 2.0,
    ("nerfstudio", "applied_transform"): [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]],
    ("nerfstudio", "rolling_shutter"): [0, 0, 0.1, 0],
    ("nerfstudio", "w"): 900,
    ("nerfstudio", "h"): 700,
    **{("nerfstudio", key): 0.5 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")},
    **{(kind, "name"): "other" for kind in ("caliscope", "aniposelib")},
    **{(kind, "fisheye"): True for kind in ("caliscope", "aniposelib")},
    **{(kind, "size"): [900, 700] for kind in ("caliscope", "aniposelib")},
    **{(kind, "matrix"): BIG for kind in ("caliscope", "aniposelib")},
    **{(kind, "distortions"): [0.3, 0, 0, 0, 0] for kind in ("caliscope", "aniposelib")},
    **{(kind, "rotation"): TURNED for kind in ("caliscope", "aniposelib")},
    **{(kind, "translation"): [0.1, 0.2, 1] for kind in ("caliscope", "aniposelib")},
    ("caliscope", "ignore"): True,
    ("aniposelib", "metadata.unit"): "cm",
    ("opencv-yaml", "names"): ["cam00", "cam02", "cam03"],
    ("opencv-yaml", "K_<name>"): BIG,
    ("opencv-yaml", "dist_<name>"): [[0.3, 0, 0, 0, 0]],
    ("opencv-yaml", "R_<name>"): TURNED,
    ("opencv-yaml", "Rot_<name>"): TURNED,
    ("opencv-yaml", "T_<name>"): [[0.1], [0.2], [1]],
    ("opencv-yaml", "D_<name>"): [[0.3, 0, 0, 0, 0]],
    ("opencv-yaml", "distCoeffs_<name>"): [[0.3, 0, 0, 0, 0]],
    ("opencv-yaml", "W_<name>"): 900,
    ("opencv-yaml", "H_<name>"): 700,
}
ELSEWHERE = {("colmap", "sparse/1")}  # told by what reads the folder: tests/rig/formats/test_strays.py
# Read, and without effect for this value or in this place: what else the row says is in the test named.
AS_IT_IS = {
    ("metashape", "group@label"): "test_labels_that_repeat_take_their_groups",
    ("metashape", "camera@component_id"): "test_cameras_of_two_components_are_refused",
    ("metashape", "chunk/components"): "test_cameras_of_two_components_are_refused",
    ("metashape", "component@id"): "test_cameras_of_two_components_are_refused",
    ("metashape", "chunk/transform"): "test_a_metashape_export_projects_by_its_manual",
    ("metashape", "calibration@class"): "test_a_metashape_export_projects_by_its_manual",
    ("realitycapture", "ComponentId"): "test_cameras_of_two_components_are_refused",
}


def signature(read: CamerasRead) -> tuple[object, ...]:
    lenses = [(c.name, c.intrinsics.width, c.intrinsics.height, repr(c.recorded)) for c in read.rig]
    seen = [np.round(camera.project(POINTS), 4).tolist() for camera in read.rig]
    return lenses, seen, tuple(read.left_out)


@pytest.mark.parametrize("kind", FOREIGN_KEYS)
def test_what_is_written_here_has_no_key_that_is_told(kind: str, tmp_path: Path) -> None:
    assert read_cameras(base(kind, tmp_path)).remarks == ()


@pytest.mark.parametrize(("kind", "key"), ROWS)
def test_each_key_is_treated_as_its_row_says(kind: str, key: str, tmp_path: Path) -> None:
    rule = FOREIGN_KEYS[kind][1][key]
    if (kind, key) in ELSEWHERE:
        return
    path = base(kind, tmp_path)
    before = signature(read_cameras(path))
    PLANTS[kind](path, key, VALUES.get((kind, key), 7))
    word = re.split(r"[@/\[\].]", key.replace("<name>", "cam01").rstrip("]"))[-1]
    if rule.treatment == "refused":
        with pytest.raises(InputError, match=word):
            read_cameras(path)
        return
    if rule.treatment == "read" and (kind, key) not in AS_IT_IS:
        try:
            assert signature(read_cameras(path)) != before
        except InputError:
            assert (kind, key) in VALUES or kind in ("metashape", "colmap")  # refused for what it says
        return
    read = read_cameras(path)
    assert signature(read) == before
    remarks = [remark for remark in read.remarks if word in remark.text]
    assert bool(remarks) == (rule.treatment == "told")
    assert len(read.remarks) == len(remarks)


@pytest.mark.parametrize(("kind", "key"), [(kind, "frobnicated") for kind in FOREIGN_KEYS if kind != "colmap"])
def test_a_key_that_the_table_does_not_have_is_told_once(kind: str, key: str, tmp_path: Path) -> None:
    path = base(kind, tmp_path)
    name = {"metashape": f"camera@{key}", "opencv-yaml": f"{key}_<name>", "realitycapture-csv": key}.get(kind, key)
    PLANTS[kind](path, name, 1)
    (remark,) = read_cameras(path).remarks
    assert remark.code == "unknown-key"
    assert key in remark.text


def test_the_page_shows_the_table() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for title, table in FOREIGN_KEYS.values():
        assert f"## {title}\n\n{markdown_table(table)}\n" in text


def test_every_value_of_these_tests_belongs_to_a_row() -> None:
    assert {*VALUES, *AS_IT_IS, *ELSEWHERE} <= {*ROWS}


@pytest.mark.parametrize("value", [None, 0, "0", "0.000", [0, 0.0, [0]], {"a": 0}, "", "0 0 0", False])
def test_values_that_say_nothing(value: object) -> None:
    assert says_nothing(value, ForeignKey("refused", "", (0,)))


@pytest.mark.parametrize("value", [1, "x", [0, 1e-9], "0 0 1", True, float("nan")])
def test_values_that_say_something(value: object) -> None:
    assert not says_nothing(value, ForeignKey("refused", "", (0,)))


def with_lens(rig: Rig, coefficients: tuple[float, ...]) -> Rig:
    lens = RecordedLens("kannala-brandt", coefficients)
    straight = [replace(camera.intrinsics, distortion=Distortion()) for camera in rig]
    return Rig(tuple(replace(c, recorded=lens, intrinsics=k) for c, k in zip(rig, straight, strict=True)))


@pytest.mark.parametrize("place", ["top", "frame"])
def test_instant_ngp_says_a_fisheye_by_its_flag(place: str, tmp_path: Path) -> None:
    rig = with_lens(fan(3), (0.02, -0.01, 0.003, 1e-3))
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
    with pytest.raises(InputError, match="cam00: p1 is not 0, and a fisheye has k1, k2, k3, k4 alone"):
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
    assert remark.text.startswith('cam01, cam03 switched off (enabled="false") in cameras.xml')
    with pytest.raises(InputError, match="enabled is 'perhaps', wanted true or false"):
        read_cameras(metashape(tmp_path, ('label="cam01">', 'label="cam01" enabled="perhaps">')))


def test_cameras_that_are_not_aligned_are_told(tmp_path: Path) -> None:
    read = read_cameras(metashape(tmp_path, (r'(label="cam02">)\s*<transform>[^<]*</transform>', r"\1")))
    assert list(read.left_out) == ["cam02"]
    assert "cam02 not aligned in cameras.xml" in read.remarks[0].text


def test_a_dot_in_a_label_belongs_to_the_name(tmp_path: Path) -> None:
    read = read_cameras(metashape(tmp_path, (r'label="cam(\d\d)">', r'label="2024.11.25_cam.\1">')))
    assert read.rig.names[0] == "2024.11.25_cam.00"
    read = read_cameras(metashape(tmp_path, (r'label="cam(\d\d)">', r'label="shots\\\\cam.\1.TIF">')))
    assert read.rig.names[0] == "cam.00"


def test_labels_that_repeat_take_their_groups(tmp_path: Path) -> None:
    grouped = (
        r'(<camera id="(\d+)" sensor_id="\d+" label=")(cam\d\d)(".*?</camera>)',
        r'<group id="\2" label="\3" type="folder">\1IMG_0001\4</group>',
    )
    assert read_cameras(metashape(tmp_path, grouped)).rig.names == fan(5).names


def test_slaves_of_a_rig_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_cameras(metashape(tmp_path, (r'<sensor id="([1-9])"', r'<sensor id="\1" master_id="0"')))
    (fault,) = refused.value.faults
    assert "4 cameras (cam01, cam02, cam03, cam04): sensor@master_id is '0': slave of another sensor" in fault.text
    read_cameras(metashape(tmp_path, (r'<sensor id="([1-9])"', r'<sensor id="\1" master_id="\1"')))  # their own


def test_cameras_of_two_components_are_refused(tmp_path: Path) -> None:
    two = '<components><component id="0"/><component id="1"/></components><cameras'
    apart = ((r"<cameras", two), (r'label="cam0([01])">', r'label="cam0\1" component_id="\1">'))
    with pytest.raises(InputError, match="stand in no known place to each other"):
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


def test_the_page_names_the_files_of_cameras_that_are_not_read() -> None:
    page = PAGE.read_text(encoding="utf-8").split("## Not read")[1]
    assert [pattern for pattern, _ in PATTERNS if f"`{pattern}`" not in page] == []
    assert [key for key in OPENCV_KEYS if key.decode().strip("\n:").lower() not in page.lower()] == []
