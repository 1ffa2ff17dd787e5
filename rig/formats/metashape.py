"""Agisoft Metashape's XML of cameras (File > Export > Export Cameras, format Agisoft XML).

Each camera has its transform to the chunk (4 x 4, axes as OpenCV's); the transform of their component or of the chunk
takes them to the world, in metres. The lens (user manual, appendix "Camera models"): ``u = w / 2 + cx + x' f + x' b1 +
y' b2`` with the corner of the picture at 0, so that half a pixel is taken off; p1 and p2 stand the other way
round than OpenCV's; type ``fisheye`` is equidistant, which with k1 to k4 is Kannala and Brandt's lens.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rig.atomic_write import write_atomically
from rig.camera import Camera
from rig.errors import InputError
from rig.formats.foreign import LENS_LOSS_PX, brown_conrady, corner_radius, judged_rig, lens_entry, parsed, xml_root
from rig.rig import Rig

KEYS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
Similarity = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], float]  # rotation, translation (mm), scale


def read_metashape(path: Path) -> Rig:
    """The aligned cameras of a Metashape export, named by their labels. Raises InputError naming every fault."""
    root = parsed(path, xml_root)
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise InputError(path.name, ["holds no <chunk>: wanted Metashape's Export Cameras, Agisoft XML"])
    faults: list[str] = []
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    worlds = {part.get("id"): part for part in chunk.iterfind("components/component")}
    entries = []
    for camera in chunk.iterfind("cameras//camera"):
        matrix = camera.find("transform")
        if matrix is None:  # not aligned
            continue
        name = Path((camera.get("label") or "").replace("\\", "/")).name.split(".")[0]
        sensor = sensors.get(camera.get("sensor_id"))
        if sensor is None or sensor.get("master_id") not in (None, sensor.get("id")):
            faults.append(f"{name}: its sensor {camera.get('sensor_id')!r:.20} is missing, or a slave of another's")
            continue
        world = worlds.get(camera.get("component_id"), chunk)
        if world.find("transform") is None:
            world = chunk
        entries.append(
            _entry(name, sensor, _numbers(matrix, 16, f"{name}.transform", faults), _similarity(world, faults))
        )
        _add_lens(entries[-1], sensor, name, faults)
    return judged_rig(entries, path.name, faults)


def write_metashape(rig: Rig, path: Path) -> None:
    """Writes the export that ``read_metashape`` reads. Raises InputError for a lens that Metashape does not have."""
    rational = [camera.name for camera in rig if camera.recorded is not None and camera.recorded.model == "rational"]
    if rational:
        raise InputError("metashape", [f"has no lens with k4 k5 k6 as a quotient, as {', '.join(rational)} have"])
    document = ElementTree.Element("document", version="1.2.0")
    chunk = ElementTree.SubElement(document, "chunk", label="rig", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(rig)))
    cameras = ElementTree.SubElement(chunk, "cameras", next_id=str(len(rig)), next_group_id="0")
    for number, camera in enumerate(rig):
        _write_sensor(sensors, number, camera)
        pose = camera.camera_from_world.inverse()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation / 1000.0
        node = ElementTree.SubElement(cameras, "camera", id=str(number), sensor_id=str(number), label=camera.name)
        ElementTree.SubElement(node, "transform").text = " ".join(map(repr, matrix.ravel().tolist()))
    world = ElementTree.SubElement(chunk, "transform")
    ElementTree.SubElement(world, "rotation", locked="true").text = "1 0 0 0 1 0 0 0 1"
    ElementTree.SubElement(world, "translation", locked="true").text = "0 0 0"
    ElementTree.SubElement(world, "scale", locked="true").text = "1"
    ElementTree.indent(document)
    write_atomically(path, ElementTree.tostring(document, encoding="UTF-8", xml_declaration=True))


def _entry(name: str, sensor: ElementTree.Element, matrix: np.ndarray, world: Similarity) -> dict[str, object]:
    rotation, translation, scale = world
    axes, centre = matrix.reshape(4, 4)[:3, :3], matrix.reshape(4, 4)[:3, 3]
    from_world = (rotation @ axes).T
    size = sensor.find("resolution")
    if size is None:
        size = sensor.find("calibration/resolution")
    return {
        "name": name,
        "width": _whole(size, "width"),
        "height": _whole(size, "height"),
        "camera_from_world": {
            "rotation": from_world.tolist(),
            "translation": (-from_world @ (scale * (rotation @ centre) + translation)).tolist(),
        },
    }


def _similarity(node: ElementTree.Element, faults: list[str]) -> Similarity:
    """The chunk's transform to the world, metres made mm; without one, its free scale is taken as millimetres."""
    found = node.find("transform")
    if found is None:
        return np.eye(3), np.zeros(3), 1.0
    rotation = _numbers(found.find("rotation"), 9, "transform.rotation", faults).reshape(3, 3)
    translation = _numbers(found.find("translation"), 3, "transform.translation", faults)
    scale = _numbers(found.find("scale"), 1, "transform.scale", faults)[0]
    return rotation, 1000.0 * translation, 1000.0 * float(scale)


def _add_lens(entry: dict[str, object], sensor: ElementTree.Element, name: str, faults: list[str]) -> None:
    calibrations = sensor.findall("calibration")
    found = next((node for node in calibrations if node.get("class") == "adjusted"), None)
    if found is None:
        found = calibrations[0] if calibrations else ElementTree.Element("calibration")
    values: dict[str, float] = {}
    for key in KEYS:
        node = found.find(key)
        values[key] = 0.0 if node is None else float(_numbers(node, 1, f"{name}.{key}", faults)[0])
    kind = sensor.get("type") or found.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        faults.append(f"{name} is a {kind!r:.20} camera; frame and fisheye are read")
    width, height = (entry[key] if isinstance(entry[key], int) else 0 for key in ("width", "height"))
    assert isinstance(width, int)
    assert isinstance(height, int)
    _name_lost(values, (width, height), name, faults)
    centre = values["cx"] + 0.5 * width, values["cy"] + 0.5 * height
    focal = values["f"] + values["b1"], values["f"]
    entry["intrinsics"] = {"fx": focal[0], "fy": focal[1], "cx": centre[0] - 0.5, "cy": centre[1] - 0.5}
    if kind == "fisheye":
        entry["distortion"] = lens_entry(values, fisheye=True)
        return
    radial = [values[key] for key in ("k1", "k2", "k3", "k4")]
    k1, k2, k3 = brown_conrady(radial, corner_radius((width, height), focal, centre), values["f"], name, faults)
    entry["distortion"] = lens_entry({"k1": k1, "k2": k2, "k3": k3, "p1": values["p2"], "p2": values["p1"]})


def _name_lost(values: Mapping[str, float], size: tuple[int, int], name: str, faults: list[str]) -> None:
    """Names what of a lens neither Brown-Conrady nor Kannala-Brandt hold and a pixel would show."""
    skewed_px = abs(values["b2"]) * size[1] / 2 / values["f"] if values["f"] > 0 else 0.0
    if skewed_px > LENS_LOSS_PX:
        faults.append(f"{name}.b2 skews the picture by {skewed_px:.2f} px: calibrate without it")
    if values["p3"] or values["p4"]:
        faults.append(f"{name}: p3 and p4 are not zero: calibrate without them")


def _write_sensor(sensors: ElementTree.Element, number: int, camera: Camera) -> None:
    k, d = camera.intrinsics, camera.intrinsics.distortion
    kind = "frame" if camera.recorded is None else "fisheye"
    sensor = ElementTree.SubElement(sensors, "sensor", id=str(number), label=camera.name, type=kind)
    size = {"width": str(k.width), "height": str(k.height)}
    ElementTree.SubElement(sensor, "resolution", size)
    calibration = ElementTree.SubElement(sensor, "calibration", {"type": kind, "class": "adjusted"})
    ElementTree.SubElement(calibration, "resolution", size)
    values = {"f": k.fy, "cx": k.cx + 0.5 - 0.5 * k.width, "cy": k.cy + 0.5 - 0.5 * k.height, "b1": k.fx - k.fy}
    if camera.recorded is None:
        values |= {"k1": d.k1, "k2": d.k2, "k3": d.k3, "p1": d.p2, "p2": d.p1}
    else:
        values |= dict(zip(("k1", "k2", "k3", "k4"), camera.recorded.coefficients, strict=True))
    for key, value in values.items():
        ElementTree.SubElement(calibration, key).text = repr(float(value))


def _numbers(node: ElementTree.Element | None, count: int, where: str, faults: list[str]) -> np.ndarray:
    words = (node.text or "").split() if node is not None else []
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count:
        faults.append(f"{where} is missing or not {count} number{'s' * (count > 1)}")
        return np.full(count, np.nan)
    return values


def _whole(node: ElementTree.Element | None, key: str) -> int | None:
    text = node.get(key) if node is not None else None
    return int(text) if text is not None and text.isdecimal() and len(text) < 7 else None
