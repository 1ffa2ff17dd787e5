"""Rig files of every foreign program with one key planted into each."""

import csv
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np

from rig.formats.cameras.cameras_file import write_rig_file
from rig.formats.cameras.colmap import COLMAP_MODELS, REFUSED_MODELS
from tests.support.fan_rig import NAMES, fan, find_cameras, square, write_blanks

Plant = Callable[[Path, str, object], None]


def base(kind: str, folder: Path) -> Path:
    """A capture's folder with a rig of that kind, complete enough for every key to have its place."""
    rig = square(fan(4)) if kind == "realitycapture-csv" else fan(4)
    written = "colmap-text" if kind == "colmap" else kind
    write_rig_file(rig, folder / NAMES[written], written)
    if kind.startswith("realitycapture"):
        write_blanks(rig, folder)
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
    return find_cameras(folder)


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
        words[3] = " ".join(str(value) if i == at else word for i, word in enumerate(words[3].split()))
        path.write_text("\n".join(words))
    elif key == "POINTS2D[]":
        lines[7] = "1.5 2.5 -1 3.5 4.5 7"
        images.write_text("\n".join([line for line in lines if line.strip()]))
    else:
        at = {"IMAGE_ID": 0, "QW QX QY QZ": 4, "TX TY TZ": 5, "NAME": 9}[key]
        lines[6] = " ".join(str(value) if i == at else word for i, word in enumerate(lines[6].split()))
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
