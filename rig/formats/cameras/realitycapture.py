"""Reads and writes cameras of RealityCapture and RealityScan, in XMP files beside the pictures and in the CSV format
"Internal/External camera parameters".

In XMP (https://support.capturingreality.com/hc/en-us/articles/360017783459), ``Rotation`` is camera_from_world with
OpenCV's axes, and ``Position`` is the camera's centre in metres. The focal length is for a film whose longer side is 36
mm. In XMP the principal point is relative to the picture's middle, in multiples of the longer side. The CSV has the
focal length of XMP, the principal point in millimetres on the film, and heading, pitch and roll in degrees. With all
three angles zero, a camera points down with its top to the north. The picture's size comes from the picture files.
Distortion applies to ``X / Z`` with k1 to k4; t1 and t2 are OpenCV's p1 and p2."""

import csv
import io
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rig.camera import Camera
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.cameras.foreign import (
    CamerasRead,
    Reading,
    brown_conrady,
    camera_entry,
    camera_names,
    corner_radius,
    lens_entry,
    parsed,
    shown,
    sized,
    word_numbers,
    xml_root,
)
from rig.formats.cameras.foreign_keys import REALITYCAPTURE, REALITYCAPTURE_CSV
from rig.formats.pictures.picture_names import is_junk, picture_stem
from rig.messages.message import Message, compose
from rig.rig import Rig

XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
FILM_MM = 36.0
MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
NO_LENS = "division"  # model named in files that have no coefficients
COLUMNS = ("#name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
DOWN = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera axes from those of the CSV: x right, y up, z backwards

_XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute" xcr:DistortionModel="brown3t2"
       xcr:FocalLength35mm="{focal!r}" xcr:Skew="0" xcr:AspectRatio="{aspect!r}" xcr:PrincipalPointU="{u!r}"
       xcr:PrincipalPointV="{v!r}" xcr:CalibrationPrior="locked" xcr:CalibrationGroup="-1" xcr:DistortionGroup="-1"
       xcr:InTexturing="1" xcr:InMeshing="1" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>{rotation}</xcr:Rotation>
      <xcr:Position>{position}</xcr:Position>
      <xcr:DistortionCoeficients>{lens}</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""


def read_xmp(file: Path) -> CamerasRead:
    """Returns the rig in all XMP files of the folder that contains ``file``, each with one camera. Cameras that are not
    aligned or not used for meshing are excluded. Raises InputError naming every fault."""
    folder = file.parent
    reading = Reading(f"{folder.name}/*.xmp")
    entries = []
    components = set()
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() == ".xmp" and not is_junk(path.name)):
        try:
            values = _xmp_values(path)
        except InputError as error:
            reading.faults += [compose("of-file", file=path.name, fault=fault) for fault in error.faults]
            continue
        name = picture_stem(path.stem)  # RealityScan also writes cam00.png.xmp
        if not {"Rotation", "Position"} & values.keys():
            reading.leave_out(name, compose("left-not-aligned-keys", keys=("Rotation", "Position")))
        elif values.get("InMeshing", "1").strip().lower() in ("0", "false"):
            reading.leave_out(name, compose("left-switched-off", key='InMeshing="0"'))
        else:
            reading.judge(REALITYCAPTURE, values, name)
            components |= {values["ComponentId"]} if "ComponentId" in values else set()
            entries.append(_xmp_entry(folder, name, values, reading.faults))
    if len(components) > 1:
        reading.faults.append(compose("components-unaligned", components=len(components)))
    return reading.finish(entries)


def write_xmp(rig: Rig, folder: Path) -> None:
    """Writes ``<camera>.xmp`` files beside the pictures. Raises InputError for an unsupported lens."""
    for camera in _held(rig, "realitycapture"):
        k, d, side = camera.intrinsics, camera.intrinsics.distortion, _side(camera)
        text = _XMP.format(
            focal=k.fx / side * FILM_MM,
            aspect=k.fy / k.fx,
            u=(k.cx + 0.5 - 0.5 * k.width) / side,
            v=(k.cy + 0.5 - 0.5 * k.height) / side,
            rotation=_words(camera.camera_from_world.rotation.ravel()),
            position=_words(camera.centre_world / 1000.0),
            lens=_words(np.array([d.k1, d.k2, d.k3, 0.0, d.p1, d.p2])),
        )
        write_atomically(folder / f"{camera.name}.xmp", text.encode())


def read_csv(path: Path) -> CamerasRead:
    """Returns the rig in a CSV file of RealityCapture. Raises InputError naming every fault."""
    rows = parsed(path, lambda data: list(csv.DictReader(io.StringIO(_with_commas(data.decode())))))
    if not rows or not set(COLUMNS[:8]) <= rows[0].keys():
        raise InputError(path.name, [compose("no-camera-csv", columns=",".join(COLUMNS))])
    reading = Reading(path.name)
    faults = reading.faults
    entries = []
    for name, row in zip(camera_names([str(row["#name"]) for row in rows]), rows, strict=True):
        reading.judge(REALITYCAPTURE_CSV, {str(key): value for key, value in row.items() if key}, name)
        values = {key: word_numbers(row.get(key, "0"), 1, f"{name}.{key}", faults)[0] for key in COLUMNS[1:]}
        size = sized(path.parent, name, faults)
        side = max(size)
        focal = values["f"] / FILM_MM * side
        offset = values["px"] / FILM_MM * side, values["py"] / FILM_MM * side
        position = np.array([values["x"], values["y"], values["alt"]])
        rotation = DOWN @ _attitude(values).T
        entries.append(_entry(name, size, (focal, focal), offset, values, rotation, position_m=position, faults=faults))
    return reading.finish(entries)


def looks_like_csv(head: str) -> bool:
    """Returns whether a text begins like a CSV file of RealityCapture, perhaps saved by a spreadsheet program."""
    return _with_commas(head).startswith(",".join(COLUMNS[:8]))


def _with_commas(text: str) -> str:
    """Converts a table with semicolons and decimal commas, as some spreadsheets have, to one with commas."""
    return text.replace(",", ".").replace(";", ",") if text.startswith(COLUMNS[0] + ";") else text


def write_csv(rig: Rig, path: Path) -> None:
    """Writes the CSV file. Raises InputError for pixels that are not square or an unsupported lens."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    from scipy.spatial.transform import Rotation

    for camera in _held(rig, "realitycapture-csv"):
        k, d, side = camera.intrinsics, camera.intrinsics.distortion, _side(camera)
        if abs(k.fx / k.fy - 1) * side > 0.02:
            raise InputError("realitycapture-csv", [compose("focal-lengths-differ", camera=camera.name)])
        turned = Rotation.from_matrix(camera.camera_from_world.rotation.T @ DOWN)
        with warnings.catch_warnings(action="ignore"):  # of a level camera, whose heading and roll are one angle
            angles = (turned.as_euler("ZXY", degrees=True) * (-1.0, 1.0, 1.0)).tolist()
        offset = np.array([k.cx + 0.5 - 0.5 * k.width, k.cy + 0.5 - 0.5 * k.height]) / side * FILM_MM
        lens = [d.k1, d.k2, d.k3, 0.0, d.p1, d.p2]
        position = (camera.centre_world / 1000.0).tolist()
        row = [*position, *angles, k.fx / side * FILM_MM, *offset.tolist(), *lens]
        writer.writerow([f"{camera.name}.png", *map(repr, row)])
    write_atomically(path, out.getvalue().encode())


def _attitude(values: Mapping[str, float]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation ``world_from_camera`` in the CSV's axes, from heading (clockwise about z), pitch (about x)
    and roll (about y)."""
    from scipy.spatial.transform import Rotation

    angles = [-values["heading"], values["pitch"], values["roll"]]
    return Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()


def _xmp_values(path: Path) -> dict[str, str]:
    """Returns the values in the namespace ``xcr`` by name, from attributes and elements."""
    described = parsed(path, xml_root).find(f".//{RDF}Description")
    if described is None:
        raise InputError(path.name, [compose("no-rdf-description")])
    values = {key.removeprefix(XCR): text for key, text in described.attrib.items() if key.startswith(XCR)}
    return values | {node.tag.removeprefix(XCR): node.text or "" for node in described if node.tag.startswith(XCR)}


def _xmp_entry(folder: Path, name: str, values: Mapping[str, str], faults: list[Message]) -> dict[str, object]:
    def numbers(key: str, count: int, default: str = "") -> np.ndarray:
        return word_numbers(values.get(key, default), count, f"{name}.{key}", faults)

    model = values.get("DistortionModel", "perspective")
    bent = any(word.strip("0.-+") for word in values.get("DistortionCoeficients", "").split())
    if model not in MODELS and (bent or model != NO_LENS):
        faults.append(compose("distortion-model", camera=name, model=shown(model), known=MODELS))
    size = sized(folder, name, faults)
    side = max(size)
    focal = numbers("FocalLength35mm", 1)[0] / FILM_MM * side
    aspect = numbers("AspectRatio", 1, "1")[0]
    offset = numbers("PrincipalPointU", 1, "0")[0] * side, numbers("PrincipalPointV", 1, "0")[0] * side
    lens = numbers("DistortionCoeficients", 6, "0 0 0 0 0 0")
    rotation, position = numbers("Rotation", 9).reshape(3, 3), numbers("Position", 3)
    named: dict[str, float] = dict(zip(("k1", "k2", "k3", "k4", "t1", "t2"), lens.tolist(), strict=True))
    return _entry(name, size, (focal, focal * aspect), offset, named, rotation, position_m=position, faults=faults)


def _entry(
    name: str,
    size: tuple[int, int],
    focal: tuple[float, float],
    offset: tuple[float, float],
    lens: Mapping[str, float],
    rotation: np.ndarray,
    *,
    position_m: np.ndarray,
    faults: list[Message],
) -> dict[str, object]:
    centre = offset[0] + 0.5 * size[0], offset[1] + 0.5 * size[1]
    radial = [lens[key] for key in ("k1", "k2", "k3", "k4")]
    k1, k2, k3 = brown_conrady(radial, corner_radius(size, focal, centre), focal[1], name, faults)
    held = lens_entry({"k1": k1, "k2": k2, "k3": k3, "p1": lens["t1"], "p2": lens["t2"]}, name, faults)
    intrinsics = *focal, centre[0] - 0.5, centre[1] - 0.5
    return camera_entry(name, size, intrinsics, held, rotation, -rotation @ (1000.0 * position_m))


def _held(rig: Rig, kind: str) -> Rig:
    foreign = [camera.name for camera in rig if camera.recorded is not None]
    if foreign:
        raise InputError(kind, [compose("format-without-lens", cameras=foreign)])
    return rig


def _side(camera: Camera) -> int:
    return max(camera.intrinsics.width, camera.intrinsics.height)


def _words(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))
