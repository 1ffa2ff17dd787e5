"""One synchronised shot of every camera, and the folder that holds it.

cameras.json                       (or a COLMAP, caliscope or aniposelib file: rig.layout_files)
images/<camera>.png|jpg|jpeg|tif|webp
background/<camera>.<ext>  or  background/<camera>/<anything>.<ext>
features.json                      optional
masks/<camera>.png                 optional; then background/ may be absent
"""

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, UnidentifiedImageError

from rig.errors import InputError
from rig.files import write_atomically
from rig.layout import Rig, write_rig
from rig.layout_files import find_rig_file, read_rig_file, rig_file_parts

FEATURES_FORMAT = "eigenhead-features/1"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")  # JPEG covers the MPO that many phones write into a .jpg
PIXELS_MOST = 100_000_000  # 100 Mpx, the largest studio backs; more is a decompression bomb
PLATES_MOST = 32  # clean plates read per camera
POINTS_MOST = 200  # feature points in features.json

# Sensor noise has no repeats to search for: one filter and run lengths take half the time and a sixth less space.
PNG_OPTIONS = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
]
ImageRgb = UInt8[np.ndarray, "h w 3"]
Features = Mapping[str, Mapping[str, Float[np.ndarray, " 2"]]]


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Images by camera name (RGB), clean plates, ready masks (True = subject), feature points (pixels) by landmark
    and camera, and the sha256 of every file that it was read from."""

    images: Mapping[str, ImageRgb]
    backgrounds: Mapping[str, tuple[ImageRgb, ...]] = field(default_factory=dict)
    masks: Mapping[str, Bool[np.ndarray, "h w"]] = field(default_factory=dict)
    features: Features = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)


def read_capture(folder: Path) -> tuple[Capture, Rig]:
    """Reads a capture folder. Raises InputError that names every fault in it."""
    faults: list[str] = []
    folder = capture_root(folder)
    rig_file = find_rig_file(folder)
    if rig_file is None:
        raise InputError(folder.name, ["holds no cameras.json (nor a COLMAP, caliscope or aniposelib file)"])
    try:
        rig = read_rig_file(rig_file)
    except InputError as error:
        raise InputError("capture", [f"{error.subject}: {fault}" for fault in error.faults]) from error
    capture = read_shot(folder, rig, faults)
    if faults:
        raise InputError("capture", faults)
    digests = dict(capture.digests)
    for path in rig_file_parts(rig_file):
        digests[path.relative_to(folder).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    ordered = dict(sorted(digests.items()))
    return Capture(capture.images, capture.backgrounds, capture.masks, capture.features, ordered), rig


def capture_root(folder: Path) -> Path:
    """``folder``, or the single folder in it: an archive may hold one enclosing folder."""
    if not folder.is_dir():
        raise InputError(str(folder.name or folder), ["is no folder; give the capture folder that holds cameras.json"])
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith((".", "__MACOSX"))]
    return entries[0] if len(entries) == 1 and entries[0].is_dir() and entries[0].name != "sparse" else folder


def read_shot(folder: Path, rig: Rig, faults: list[str]) -> Capture:
    """The images of a folder for a known rig; appends every fault to ``faults``."""
    jobs: list[tuple[str, str, Path]] = []
    for camera in rig:
        image = _image_file(folder / "images", camera.name, faults)
        mask = _image_file(folder / "masks", camera.name, faults)
        plates = _plate_files(folder / "background", camera.name, faults)
        if image is None:
            faults.append(f"images/{camera.name}.png is missing (or .jpg, .jpeg, .tif, .webp)")
        if not plates and mask is None:
            faults.append(
                f"background/{camera.name}.png is missing: a clean plate, or masks/{camera.name}.png, is needed"
            )
        found = [("images", image), ("masks", mask), *(("background", plate) for plate in plates)]
        jobs += [(kind, camera.name, path) for kind, path in found if path is not None]
    with ThreadPoolExecutor(max_workers=4) as pool:  # cv2 decodes outside the interpreter lock
        decoded = list(pool.map(lambda job: _decode(folder, *job, rig=rig), jobs))
    images: dict[str, np.ndarray] = {}
    masks: dict[str, np.ndarray] = {}
    backgrounds: dict[str, list[np.ndarray]] = {}
    digests: dict[str, str] = {}
    for (kind, name, path), (pixels, digest, fault) in zip(jobs, decoded, strict=True):
        if fault or pixels is None:
            faults.append(fault)
            continue
        digests[path.relative_to(folder).as_posix()] = digest
        if kind == "images":
            images[name] = pixels
        elif kind == "masks":
            masks[name] = pixels
        else:
            backgrounds.setdefault(name, []).append(pixels)
    features: Features = {}
    if (folder / "features.json").is_file():
        data = (folder / "features.json").read_bytes()
        digests["features.json"] = hashlib.sha256(data).hexdigest()
        features = features_from_bytes(data, rig, faults)
    return Capture(images, {name: tuple(plates) for name, plates in backgrounds.items()}, masks, features, digests)


def features_from_bytes(data: bytes, rig: Rig, faults: list[str]) -> Features:
    """The points of a ``features.json``; appends every fault to ``faults``."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        faults.append(f"features.json cannot be read as JSON ({error})")
        return {}
    return features_from_document(document, rig, faults)


def features_from_document(document: Any, rig: Rig, faults: list[str]) -> Features:
    """The points of a decoded ``features.json``; appends every fault to ``faults``."""
    if not isinstance(document, dict) or not isinstance(document.get("points"), dict):
        faults.append("features.json is no object with an object 'points'")
        return {}
    if document.get("format") != FEATURES_FORMAT:
        faults.append(f"features.json: format is {document.get('format')!r:.80}, wanted {FEATURES_FORMAT!r}")
    if len(document["points"]) > POINTS_MOST:
        faults.append(f"features.json: {len(document['points'])} points, at most {POINTS_MOST} are read")
        return {}
    features: dict[str, dict[str, np.ndarray]] = {}
    for landmark, views in document["points"].items():
        if not isinstance(views, dict):
            faults.append(f"features.json: {landmark!r:.80} is no object of camera: [u, v]")
            continue
        for name, pixel in views.items():
            point = _pixel(pixel)
            if name not in rig:
                faults.append(f"features.json: {landmark!r:.80} names camera {name!r:.80}, which the rig does not have")
            elif point is None:
                faults.append(f"features.json: {landmark!r:.80} in {name}: {pixel!r:.80} is no pair of finite pixels")
            elif not _inside(point, rig[name].intrinsics.width, rig[name].intrinsics.height):
                faults.append(f"features.json: {landmark!r:.80} in {name}: {pixel!r:.80} lies outside the image")
            else:
                features.setdefault(landmark, {})[name] = point
    return features


def document_from_features(features: Features) -> dict[str, Any]:
    points = {k: {name: [float(x) for x in pixel] for name, pixel in views.items()} for k, views in features.items()}
    return {"format": FEATURES_FORMAT, "points": points}


def write_capture(folder: Path, capture: Capture, rig: Rig) -> None:
    """Writes a capture folder of PNG files; every file under a temporary name first."""
    write_rig(rig, folder / "cameras.json")
    files: list[tuple[Path, np.ndarray]] = []
    for name, image in capture.images.items():
        files.append((folder / "images" / f"{name}.png", image))
    for name, plates in capture.backgrounds.items():
        several = len(plates) > 1
        for i, plate in enumerate(plates):
            files.append((folder / "background" / (f"{name}/{i:03}.png" if several else f"{name}.png"), plate))
    for name, mask in capture.masks.items():
        files.append((folder / "masks" / f"{name}.png", mask.astype(np.uint8) * 255))
    with ThreadPoolExecutor(max_workers=4) as pool:
        list(pool.map(lambda file: write_image(*file), files))
    if capture.features:
        text = json.dumps(document_from_features(capture.features), indent=1)
        write_atomically(folder / "features.json", text.encode())


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], quality: int = 95) -> None:
    """Writes RGB or grey pixels as the format of the suffix."""
    image = np.ascontiguousarray(image)
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if path.suffix == ".jpg" else PNG_OPTIONS
    done, data = cv2.imencode(path.suffix, pixels, options)
    assert done
    write_atomically(path, data.tobytes())


def read_image(path: Path) -> ImageRgb:
    """An RGB image. Raises InputError."""
    pixels, _, fault = _decode_file(path, path.name, grey=False)
    if pixels is None:
        raise InputError(path.name, [fault])
    return pixels


def _decode(folder: Path, kind: str, name: str, path: Path, *, rig: Rig) -> tuple[np.ndarray | None, str, str]:
    k = rig[name].intrinsics
    where = path.relative_to(folder).as_posix()
    pixels, digest, fault = _decode_file(path, where, grey=kind == "masks")
    if pixels is not None and pixels.shape[:2] != (k.height, k.width):
        height, width = pixels.shape[:2]
        return None, "", f"{where} is {width} x {height} pixels, but its camera is {k.width} x {k.height}"
    if pixels is not None and kind == "masks":
        pixels = pixels > 0
        if not pixels.any():
            return None, "", f"{where} is empty: no pixel belongs to the subject"
    if pixels is not None:
        pixels.setflags(write=False)
    return pixels, digest, fault


def _decode_file(path: Path, where: str, *, grey: bool) -> tuple[np.ndarray | None, str, str]:
    data = path.read_bytes()
    try:
        with Image.open(BytesIO(data), formats=IMAGE_FORMATS) as header:  # reads the header only
            width, height = header.size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None, "", f"{where} is damaged or no PNG, JPEG, TIFF or WebP image"
    if width * height > PIXELS_MOST:
        return None, "", f"{where} is {width} x {height} pixels; at most {PIXELS_MOST:,} are read"
    flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR_RGB
    # The calibration holds for the sensor's own rows and columns, whatever an EXIF flag says of the picture.
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None or (path.suffix.lower() == ".png" and b"IEND" not in data[-16:]):
        return None, "", f"{where} is damaged: its pixels cannot be decoded"
    return pixels, hashlib.sha256(data).hexdigest(), ""


def _image_file(folder: Path, stem: str, faults: list[str]) -> Path | None:
    found = [path for path in _listed(folder) if path.stem == stem and path.is_file()]
    if len(found) > 1:
        faults.append(f"{folder.name}/ holds {' and '.join(path.name for path in found)}: which one is meant?")
    return found[0] if found else None


def _plate_files(folder: Path, stem: str, faults: list[str]) -> list[Path]:
    single = _image_file(folder, stem, faults)
    several = _listed(folder / stem)[:PLATES_MOST]
    return [single] if single is not None else several


def _listed(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))


def _pixel(value: Any) -> np.ndarray | None:
    if not isinstance(value, list) or len(value) != 2:
        return None
    # NaN fails the comparison, and so does a whole number too large for a float
    if not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e9 for x in value):
        return None
    return np.array(value, dtype=float)


def _inside(point: np.ndarray, width: int, height: int) -> bool:
    return bool((point >= -0.5).all() and point[0] <= width - 0.5 and point[1] <= height - 0.5)
