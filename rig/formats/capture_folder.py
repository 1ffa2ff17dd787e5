"""One synchronised shot of every camera, and the folder that holds it.

cameras.json                       (or a COLMAP, caliscope or aniposelib file: rig.formats.cameras_file)
images/<camera>.png|jpg|jpeg|tif|webp, RAW, DNG or HEIC
background/<camera>.<ext>  or  background/<camera>/<anything>.<ext>
features.json                      optional
masks/<camera>.png                 optional; then background/ may be absent

Without background/ and masks/ altogether the subject is found from the photographs. Without images/ the pictures lie
beside cameras.json; a folder of a camera's name may hold its one picture, whatever that is called; and so may a picture
be called whose EXIF has the serial number of a camera (``rig.formats.serials``), or that differs in case alone.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from rig.atomic_write import write_atomically
from rig.camera import Intrinsics
from rig.capture import Capture, Features, Remark
from rig.errors import InputError
from rig.formats.cameras_file import NO_RIG, read_rig_file, rig_file_parts, rig_files
from rig.formats.cameras_json import write_rig
from rig.formats.features_json import document_from_features, features_from_bytes
from rig.formats.images import decode_image_file, is_picture, picture_size, write_image
from rig.formats.serials import pictures_by_serial
from rig.formats.unread_keys import unread_keys
from rig.formats.work_size import at_share, work_features, work_rig, work_share
from rig.plausibility import rig_faults
from rig.rig import Rig
from rig.text import suggest

PLATES_MOST = 32  # clean plates read per camera
BESIDE_PICTURES = ("masks", "background")  # folders of a capture that are no camera's
ALIKE_LEAST = 0.75  # of the names of two folders: "backgrounds" 0.95, "Image" 0.91, "textures" 0.44


def read_capture(folder: Path, *, pixels_most: int | None = None) -> tuple[Capture, Rig]:
    """Reads a capture folder; pictures and feature points of a ``recorded`` lens come undistorted. Pictures of more
    than ``pixels_most`` pixels come smaller, and so do their cameras (``rig.formats.work_size``). Raises InputError
    that names every fault in it."""
    faults: list[str] = []
    folder = capture_root(folder)
    rigs = [*rig_files(folder)]
    if not rigs:
        raise InputError(folder.name, [NO_RIG])
    rig_file = rigs[0]
    try:
        rig = read_rig_file(rig_file)
    except InputError as error:
        raise InputError("capture", [f"{error.subject}: {fault}" for fault in error.faults]) from error
    check_folders(folder, rig)
    faults += [f"{rig_file.name}: {fault}" for fault in rig_faults(rig)]
    capture = read_shot(folder, rig, faults, by_other_names(folder, rig, faults), pixels_most=pixels_most)
    if faults:
        raise InputError("capture", faults)
    digests = dict(capture.digests)
    for path in rig_file_parts(rig_file):
        digests[path.relative_to(folder).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    ordered = dict(sorted(digests.items()))
    remarks = [Remark("unknown-key", told) for told in unread_keys(rig_file)]
    remarks += _unread_files(folder, rigs)
    return replace(capture, digests=ordered, remarks=tuple(remarks)), work_rig(rig, pixels_most)


def _unread_files(folder: Path, rigs: Sequence[Path]) -> list[Remark]:
    """Cameras of another program, and a length for cameras that are known: files that do nothing here."""
    read, *others = (path.relative_to(folder).as_posix() for path in rigs)
    told = [f"{other} is not read: the cameras come from {read}" for other in others]
    if (folder / "scale.json").is_file() and not (folder / "calibration.json").is_file():  # whose cameras it scaled
        told.append(
            f"scale.json is not read: the cameras of {read} are taken as millimetres; without that file the cameras "
            "are found from the photographs, and scaled"
        )
    return [Remark("file-unread", message) for message in told]


def capture_root(folder: Path) -> Path:
    """``folder``, or the single folder in it: an archive may hold one enclosing folder."""
    if not folder.is_dir():
        raise InputError(str(folder.name or folder), ["is no folder; give the capture folder that holds cameras.json"])
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith((".", "__MACOSX"))]
    return entries[0] if len(entries) == 1 and entries[0].is_dir() and entries[0].name != "sparse" else folder


def by_other_names(folder: Path, rig: Rig, faults: list[str]) -> dict[str, dict[str, Path]]:
    """Pictures, plates and masks that are not called exactly as their camera, by kind and camera: the case differs, the
    camera's name in the rig's file ends like a picture's, or EXIF has the serial number of the camera's body."""
    found: dict[str, dict[str, Path]] = {}
    for kind, inner in (("images", picture_folder(folder)), *((kind, folder / kind) for kind in BESIDE_PICTURES)):
        if inner.is_dir():
            found[kind] = _by_spelling(inner, rig)
            if not found[kind] and kind != "masks":
                found[kind] = pictures_by_serial(inner, rig, faults)
    return found


def _by_spelling(folder: Path, rig: Rig) -> dict[str, Path]:
    """Pictures whose name is that of one camera alone but for case, or an ending that the camera's name has, too."""
    pictures = listed_pictures(folder)
    exact = {path.stem for path in pictures}
    cameras = Counter(name.casefold() for name in rig.names)
    lacking = {name.casefold(): name for name in rig.names if name not in exact and cameras[name.casefold()] == 1}
    fitting: dict[str, list[Path]] = {}
    for path in pictures:
        keys = [key for key in (path.stem.casefold(), path.name.casefold()) if key in lacking]
        if path.stem not in rig and keys:
            fitting.setdefault(lacking[keys[0]], []).append(path)
    return {name: paths[0] for name, paths in fitting.items() if len(paths) == 1}


def check_folders(folder: Path, rig: Rig) -> None:
    """Raises InputError for folders that nobody would read, and that are meant to be one of a capture's own: without a
    word the subject would be found without its plates, or every picture be missing."""
    kinds = ("images", *BESIDE_PICTURES)
    folders = [path.name for path in sorted(folder.iterdir()) if path.is_dir()]
    others = {name.casefold(): name for name in folders if name not in (*kinds, *rig.names)}
    faults = []
    for kind in kinds:
        alike = suggest(kind, others, min_likeness=ALIKE_LEAST)
        if alike and not (folder / kind).is_dir():
            faults.append(f"{others[alike[0]]}/ is not read: call it {kind}/")
    if faults:
        raise InputError("capture", faults)


def read_shot(
    folder: Path,
    rig: Rig,
    faults: list[str],
    filed: Mapping[str, Mapping[str, Path]] = MappingProxyType({}),
    *,
    pixels_most: int | None = None,
) -> Capture:
    """The images of a folder for a known rig, as ``work_rig`` sees them; appends every fault to ``faults``. ``filed``:
    files that do not have their camera's name, as ``by_other_names`` finds them."""
    jobs: list[tuple[str, str, Path]] = []
    pictureless: list[str] = []
    plateless: list[str] = []
    pictures, alone = picture_folder(folder), not any((folder / kind).is_dir() for kind in BESIDE_PICTURES)
    for camera in rig:
        image = _image_file(pictures, camera.name, faults) or _only_picture(pictures / camera.name, faults)
        image = image or filed.get("images", {}).get(camera.name)
        mask = _image_file(folder / "masks", camera.name, faults) or filed.get("masks", {}).get(camera.name)
        plates = _plate_files(folder / "background", camera.name, faults)
        plates = plates or [path for name, path in filed.get("background", {}).items() if name == camera.name]
        if image is None:
            pictureless.append(
                f"{_inside(folder, pictures)}{camera.name}.png is missing (or .jpg, .tif, .webp, RAW, HEIC)"
            )
        if not plates and mask is None and not alone:
            plateless.append(
                f"background/{camera.name}.png is missing: a clean plate, or masks/{camera.name}.png, is needed"
            )
        found = [("images", image), ("masks", mask), *(("background", plate) for plate in plates)]
        jobs += [(kind, camera.name, path) for kind, path in found if path is not None]
    for lacking, place in ((pictureless, pictures), (plateless, folder / "background")):
        strangers = [path.name for path in listed_pictures(place)] if len(lacking) == len(rig) > 1 else []
        alike = len(strangers) < max(len(lacking), 2)
        faults += lacking if alike else [_no_name_alike(rig, _inside(folder, place), strangers)]
    with ThreadPoolExecutor(max_workers=4) as pool:  # cv2 decodes outside the interpreter lock
        decoded = list(pool.map(lambda job: _decode(folder, *job, rig=rig, pixels_most=pixels_most), jobs))
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
        features = _in_read_pictures(features_from_bytes(data, rig, faults), rig)
        features = work_features(features, rig, work_rig(rig, pixels_most))
    return Capture(images, {name: tuple(plates) for name, plates in backgrounds.items()}, masks, features, digests)


def _no_name_alike(rig: Rig, place: str, strangers: Sequence[str]) -> str:
    """One cause, said once."""
    cameras, found = f"{rig.names[0]} to {rig.names[-1]}", f"{strangers[0]} to {strangers[-1]}"
    where = place or "the folder"
    return f"no camera has a picture in {where}: the cameras are called {cameras}, the pictures {found}; rename either"


def picture_folder(folder: Path) -> Path:
    """Where a capture folder's photographs lie."""
    return folder / "images" if (folder / "images").is_dir() else folder


def _inside(folder: Path, pictures: Path) -> str:
    return "" if pictures == folder else f"{pictures.name}/"


def _only_picture(folder: Path, faults: list[str]) -> Path | None:
    """The picture in a camera's own folder."""
    found = listed_pictures(folder)
    if len(found) > 1:
        told = f"{folder.name}/ holds {len(found)} pictures; a capture is one shot: leave one of them"
        faults.append(f"{told}, and give all to calibrate --from scene")
    return found[0] if found else None


def write_capture(folder: Path, capture: Capture, rig: Rig) -> None:
    """Writes a capture folder of PNG files, the pictures as ``rig``'s cameras took them; every file under a temporary
    name first."""
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


def _in_read_pictures(features: Features, rig: Rig) -> Features:
    """Points that were picked in the files, where the pictures are undistorted as they are read."""

    def moved(name: str, pixel: np.ndarray) -> np.ndarray:
        lens = rig[name].recorded
        return pixel if lens is None else lens.undistorted(pixel[None], rig[name].intrinsics.matrix())[0]

    return {point: {name: moved(name, at) for name, at in views.items()} for point, views in features.items()}


def _decode(
    folder: Path, kind: str, name: str, path: Path, *, rig: Rig, pixels_most: int | None
) -> tuple[np.ndarray | None, str, str]:
    camera = rig[name]
    wanted, share = (camera.intrinsics.width, camera.intrinsics.height), work_share(camera.intrinsics, pixels_most)
    where, whole = path.relative_to(folder).as_posix(), kind == "masks"
    pixels, digest, fault = decode_image_file(path, where, "mask" if whole else "colour", share=1.0 if whole else share)
    if pixels is None:
        return None, digest, fault
    size = (pixels.shape[1], pixels.shape[0]) if whole or share == 1.0 else picture_size(path)
    if size != wanted:
        return None, "", size_fault(where, size, camera.intrinsics)
    if whole:  # whatever is not zero is the subject, so that it is told before pixels are averaged
        pixels = at_share(pixels, size, share)
    if camera.recorded is not None:
        matrix = work_rig(rig.subset([name]), pixels_most)[name].intrinsics.matrix()
        pixels = camera.recorded.undistort(pixels, matrix, smooth=not whole)
    if whole:
        pixels = pixels > 127
        if not pixels.any():
            return None, "", f"{where} is empty: no pixel belongs to the subject"
    pixels.setflags(write=False)
    return pixels, digest, fault


def size_fault(where: str, size: tuple[int, int], k: Intrinsics) -> str:
    """A sentence for a picture whose size (width, height) is not that of its camera."""
    fault = f"{where} is {size[0]} x {size[1]} pixels, but its camera is {k.width} x {k.height}"
    if size == (k.height, k.width):
        as_told, turned = (abs(k.cx - w / 2) + abs(k.cy - h / 2) for w, h in ((k.width, k.height), size))
        if turned < as_told:
            return f"{fault}: its principal point is that of the picture; exchange the camera's width and height"
        return f"{fault}: it was turned by 90 degrees; turn it back"
    share = size[0] / k.width
    if abs(size[1] - share * k.height) <= 1.0:
        return (
            f"{fault}, and the shape is the same: give it in the size that was calibrated, or calibrate with this one"
        )
    return fault


def stray_faults(folder: Path, rig: Rig) -> list[str]:
    """Pictures, masks and clean plates that belong to no camera of the rig, whose cameras the first names."""
    files = [path for kind in ("images", "masks", "background") for path in listed_pictures(folder / kind)]
    strays = [path.relative_to(folder).as_posix() for path in files if path.stem not in rig]
    told = [f"{name} has no camera" for name in strays]
    return [f"{strays[0]} has no camera: the rig has {', '.join(rig.names)}", *told[1:]] if told else []


def _image_file(folder: Path, stem: str, faults: list[str]) -> Path | None:
    found = [path for path in listed_pictures(folder) if path.stem == stem]
    if len(found) > 1:
        faults.append(f"{folder.name}/ holds {' and '.join(path.name for path in found)}: which one is meant?")
    return found[0] if found else None


def _plate_files(folder: Path, stem: str, faults: list[str]) -> list[Path]:
    single = _image_file(folder, stem, faults)
    return [*([single] if single is not None else []), *listed_pictures(folder / stem)][:PLATES_MOST]


def listed_pictures(folder: Path) -> list[Path]:
    """The pictures in a folder; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if is_picture(path))
