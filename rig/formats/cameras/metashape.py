"""Reads and writes cameras in Agisoft Metashape's XML format (File > Export > Export Cameras).

A chunk is Metashape's group of aligned cameras. Each Metashape camera has a 4 x 4 transform to its group's frame, with
OpenCV's camera axes. The transform of the camera's component or chunk converts from there to the world, in metres. The
lens model (user manual, appendix "Camera models") is ``u = w / 2 + cx + x' f + x' b1 + y' b2``. Metashape's pixels
count from the picture's corner, so half a pixel is subtracted. Metashape's coefficients p1 and p2 are exchanged
relative to OpenCV. A lens of type ``fisheye`` with k1 to k4 is Kannala and Brandt's lens."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rig.camera import Camera
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.cameras.foreign import (
    LENS_LOSS_PX,
    CamerasRead,
    Reading,
    brown_conrady,
    camera_entry,
    camera_names,
    corner_radius,
    lens_entry,
    parsed,
    shown,
    word_numbers,
    xml_root,
)
from rig.formats.cameras.foreign_keys import METASHAPE
from rig.messages.message import Message, compose, some_of
from rig.rig import Rig

KEYS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
TYPES = {"frame": False, "fisheye": True, "equidistant_fisheye": True}  # sensor types, and whether they are equidistant
SWITCHES = {"true": True, "1": True, "false": False, "0": False}
Similarity = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], float]  # rotation, translation (mm), scale


def read_metashape(path: Path) -> CamerasRead:
    """Returns the aligned and enabled cameras of a Metashape export. A camera's name is its label or, if labels repeat,
    its group's label. Raises InputError naming every fault."""
    root = parsed(path, xml_root)
    reading = Reading(path.name)
    chunk = _chunk(root, reading)
    _judge(chunk, "chunk", "", reading)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    parts = {part.get("id"): part for part in chunk.iterfind("components/component")}
    for part in parts.values():
        _judge(part, "component", "", reading)
    cameras = list(_cameras(chunk, reading))
    entries: list[dict[str, object]] = []
    used: set[str | None] = set()
    for name, camera in zip(_names(cameras), (camera for _, camera in cameras), strict=True):
        if _takes_part(name, camera, reading):
            sensor = sensors.get(camera.get("sensor_id"))
            if sensor is None and camera.get("master_id") is None:
                missing = shown(camera.get("sensor_id"), 20)
                reading.faults.append(compose("sensor-missing", camera=name, sensor=missing))
            _judge(camera, "camera", name, reading)
            if sensor is not None:
                entries.append(_read_camera(name, camera, sensor, chunk, parts, reading))
                used.add(camera.get("component_id"))
    alone = [part for key in used if (part := parts.get(key)) is not None and part.find("transform") is None]
    if len(used) > 1 and alone:
        reading.faults.append(compose("components-apart", components=len(used)))
    return reading.finish(entries)


def _chunk(root: ElementTree.Element, reading: Reading) -> ElementTree.Element:
    """Returns the only chunk with aligned cameras. Raises InputError for none or several such chunks."""
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    if not chunks:
        raise InputError(reading.subject, [compose("no-chunk")])
    aligned = [chunk for chunk in chunks if chunk.find("cameras//camera/transform") is not None]
    if len(aligned) > 1:
        labels = some_of([shown(chunk.get("label") or "") for chunk in aligned])
        raise InputError(reading.subject, [compose("chunks-many", chunks=len(aligned), labels=labels)])
    return (aligned or chunks)[0]


def _cameras(chunk: ElementTree.Element, reading: Reading) -> Iterator[tuple[str, ElementTree.Element]]:
    """Yields each camera with the label of its group, or an empty text if it has no group."""
    holder = chunk.find("cameras")
    for node in holder if holder is not None else ():
        if node.tag == "camera":
            yield "", node
        elif node.tag == "group":
            _judge(node, "group", "", reading, children=False)
            yield from ((node.get("label") or "", camera) for camera in node.iter("camera"))


def _names(cameras: Sequence[tuple[str, ElementTree.Element]]) -> list[str]:
    return camera_names([f"{group}/{camera.get('label') or ''}" for group, camera in cameras])


def _takes_part(name: str, camera: ElementTree.Element, reading: Reading) -> bool:
    switch = SWITCHES.get((camera.get("enabled") or "true").strip().lower())
    if switch is None:
        reading.faults.append(compose("no-switch", key=f"{name}.enabled", value=shown(camera.get("enabled"))))
    elif not switch:
        reading.leave_out(name, compose("left-switched-off", key='enabled="false"'))
    elif camera.find("transform") is None and camera.get("master_id") is None:
        reading.leave_out(name, compose("left-not-aligned"))
    return name not in reading.left_out


def _judge(
    node: ElementTree.Element, place: str, whose: str, reading: Reading, *, children: bool = True, tags: tuple = ()
) -> None:
    """Checks attributes and child elements of a node against the table of keys, except children in ``tags``."""
    keys: dict[str, object] = {f"{place}@{name}": text for name, text in node.attrib.items()}
    if place in ("sensor", "camera") and node.get("master_id") == node.get("id"):
        keys.pop(f"{place}@master_id", None)  # a camera that is its own master is no slave
    for child in node if children else ():
        if child.tag not in tags:
            named = place == "sensor" and child.tag == "property"
            key = f"{place}/{child.tag}" + (f"[{child.get('name')}]" if named else "")
            keys[key] = child.get("value") if named else (child.text or "").strip() or (True if len(child) else None)
    reading.judge(METASHAPE, keys, whose)


def _read_camera(
    name: str,
    camera: ElementTree.Element,
    sensor: ElementTree.Element,
    chunk: ElementTree.Element,
    parts: Mapping[str | None, ElementTree.Element],
    reading: Reading,
) -> dict[str, object]:
    world = parts.get(camera.get("component_id"), chunk)
    if world.find("transform") is None:
        world = chunk
    _judge(sensor, "sensor", name, reading, tags=("calibration",))
    matrix = _numbers(camera.find("transform"), 16, f"{name}.transform", reading.faults).reshape(4, 4)
    turn, shift, scale = _similarity(world, reading.faults)
    rotation = (turn @ matrix[:3, :3]).T
    translation = -rotation @ (scale * (turn @ matrix[:3, 3]) + shift)
    size = sensor.find("resolution")
    size = _size(sensor.find("calibration/resolution") if size is None else size)
    return camera_entry(name, size, *_lens(sensor, size, name, reading), rotation, translation)


def write_metashape(rig: Rig, path: Path) -> None:
    """Writes a file that Metashape and ``read_metashape`` read. Raises InputError for a lens that Metashape lacks."""
    rational = [camera.name for camera in rig if camera.recorded is not None and camera.recorded.model == "rational"]
    if rational:
        raise InputError("metashape", [compose("metashape-without-rational", cameras=rational)])
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


def _similarity(node: ElementTree.Element, faults: list[Message]) -> Similarity:
    """Returns the transform from the chunk to the world (mm). If the chunk has no transform, its arbitrary unit is
    taken as millimetres."""
    found = node.find("transform")
    if found is None or not len(found):
        return np.eye(3), np.zeros(3), 1.0
    rotation = _numbers(found.find("rotation"), 9, "transform.rotation", faults).reshape(3, 3)
    translation = _numbers(found.find("translation"), 3, "transform.translation", faults)
    scale = _numbers(found.find("scale"), 1, "transform.scale", faults)[0]
    return rotation, 1000.0 * translation, 1000.0 * float(scale)


def _lens(
    sensor: ElementTree.Element, size: tuple[int | None, int | None], name: str, reading: Reading
) -> tuple[tuple[float, ...], dict[str, str | float]]:
    """Returns fx, fy, cx and cy (px), and the ``distortion`` entry of ``eigenhead-cameras/1``."""
    faults = reading.faults
    calibrations = sensor.findall("calibration")
    found = next((node for node in calibrations if node.get("class") == "adjusted"), None)
    if found is None:
        found = calibrations[0] if calibrations else ElementTree.Element("calibration")
    values: dict[str, float] = {}
    for key in KEYS:
        node = found.find(key)
        values[key] = 0.0 if node is None else float(_numbers(node, 1, f"{name}.{key}", faults)[0])
    kind = sensor.get("type") or found.get("type") or "frame"
    if kind not in TYPES:
        faults.append(compose("camera-type", camera=name, kind=shown(kind), known=[*TYPES]))
    attributes = dict(found.attrib)
    if attributes.get("type") == kind:
        del attributes["type"]
    below = {f"/{node.tag}": node.text for node in found}
    reading.judge(METASHAPE, {f"@{key}": value for key, value in attributes.items()} | below, name, place="calibration")
    of_lens = found.find("resolution")
    if of_lens is not None and _size(of_lens) != size:
        other = f"{shown(of_lens.get('width'), 20)} x {shown(of_lens.get('height'), 20)}".replace("'", "")
        faults.append(compose("lens-of-other-size", camera=name, size=other))
    width, height = (side or 0 for side in size)
    _drop_invisible(values, (width, height), fisheye=TYPES.get(kind, False))
    centre = values["cx"] + 0.5 * width, values["cy"] + 0.5 * height
    focal = values["f"] + values["b1"], values["f"]
    intrinsics = *focal, centre[0] - 0.5, centre[1] - 0.5
    skew = values["b2"] / focal[0] if focal[0] else 0.0
    if TYPES.get(kind, False):
        held = {key: values[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
        return intrinsics, lens_entry(held, name, faults, fisheye=True, skew=skew)
    radial = [values[key] for key in ("k1", "k2", "k3", "k4")]
    k1, k2, k3 = brown_conrady(radial, corner_radius((width, height), focal, centre), values["f"], name, faults)
    held = {"k1": k1, "k2": k2, "k3": k3, "p1": values["p2"], "p2": values["p1"]}
    return intrinsics, lens_entry(held, name, faults, skew=skew)


def _drop_invisible(values: dict[str, float], size: tuple[int, int], *, fisheye: bool) -> None:
    """Removes a fisheye's ``p1`` and ``p2`` if both move the picture's corners by less than ``LENS_LOSS_PX``."""
    if fisheye and values["f"] > 0:
        reach = np.hypot(*size) / 2 / values["f"]  # of the corner, in radians
        if 3 * max(abs(values["p1"]), abs(values["p2"])) * reach**2 * values["f"] <= LENS_LOSS_PX:
            values["p1"] = values["p2"] = 0.0


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


def _numbers(node: ElementTree.Element | None, count: int, where: str, faults: list[Message]) -> np.ndarray:
    return word_numbers(None if node is None else node.text, count, where, faults)


def _size(node: ElementTree.Element | None) -> tuple[int | None, int | None]:
    """Returns width and height (px), each None if it is not a valid number of pixels."""
    texts = ["" if node is None else node.get(key, "") for key in ("width", "height")]
    whole = [int(text) if text.isdecimal() and len(text) < 7 else None for text in texts]
    return whole[0], whole[1]
