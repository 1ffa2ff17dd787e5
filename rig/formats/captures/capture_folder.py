"""Reads and writes the folder of one synchronised shot of every camera.

cameras.json                       (or another program's file: rig.formats.cameras.cameras_file)
images/<camera>.png|jpg|jpeg|tif|webp|bmp|ppm|pgm, RAW, DNG or HEIC
background/<camera>.<ext>  or  background/<camera>/<anything>.<ext>
features.json                      optional
masks/<camera>.png                 optional; then background/ may be absent
texture_sets/<set>/<camera>.<ext>  optional: further photographs by the same cameras, for the texture

Without background/ and masks/, the subject is the opaque part of the pictures if all have a transparent background;
otherwise the photographs are segmented. Without images/ the pictures lie in the same folder as cameras.json.
``shot_files`` assigns files to cameras if names differ. Large pictures are reduced
(``rig.formats.pictures.work_size``). Skin pores need all pixels, so pictures can also be read one at a time at full
size.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import ceil
from pathlib import Path

import numpy as np

from rig.camera import Intrinsics
from rig.capture import TEXTURE_SETS, Capture, Features, ReadImage
from rig.errors import InputError
from rig.files import sha256_of, write_atomically
from rig.formats.cameras.cameras_file import find_rig_file, no_rig_fault, read_cameras, rig_file_parts, rig_files
from rig.formats.cameras.cameras_json import CAMERAS_LEAST, write_rig
from rig.formats.cameras.foreign import CamerasRead, program_of, unread_programs
from rig.formats.captures.capture_masks import MaskSubjects, mask_subjects
from rig.formats.captures.features_json import document_from_features, features_from_bytes
from rig.formats.captures.shot_files import (
    BESIDE_PICTURES,
    ShotFiles,
    find_files,
    listed_pictures,
    shows_something,
    stray_sentence,
)
from rig.formats.pictures.images import cut_out_alpha, decode_image_file, page_count, picture_size, write_image
from rig.formats.pictures.picture_names import entry, is_junk
from rig.formats.pictures.picture_samples import WHOLE_BITS, fill_rims, measure_samples
from rig.formats.pictures.work_size import work_features, work_rig, work_share
from rig.image import ImageRgb, is_grey
from rig.messages.message import Message, compose, say_once, some_of
from rig.plausibility import rig_faults
from rig.rig import Rig
from rig.text import suggest

SCALE, FEATURES = "scale.json", "features.json"
NOTES = (".md", ".pdf", ".log", ".html")  # what people and programs write beside a capture
ENCLOSING_MOST = 8  # levels of single folders around a capture, as nested packing leaves them
REST_LEAST = 0.7  # share of the cameras: 8 of 11 still surround a head
BLACK = 16  # of 255: a lens with its cap on shows noise below it
LIT_LEAST = 1e-3  # share of pixels above it
ALIKE_LEAST = 0.75  # likeness of two folders' names: "backgrounds" 0.95, "Image" 0.91, "textures" 0.44
SETS_ALIKE = 0.9  # to texture_sets: "texture_set" 0.96, "texture-sets" 0.92; "textures", other programs' folder, 0.8


def read_capture(folder: Path, *, pixels_most: int | None = None) -> tuple[Capture, Rig]:
    """Reads a capture folder. Returns the folder's capture and cameras, without cameras whose pictures are unusable.

    Pictures and feature points of cameras with a ``recorded`` lens are undistorted. Pictures of more than
    ``pixels_most`` pixels are reduced, and the cameras' intrinsics scaled. Raises InputError naming every fault of the
    folder."""
    folder = capture_root(folder)
    rigs, read, files, faults = open_capture(folder)
    rig_file, rig = rigs[0], read.rig
    lost: dict[str, list[Message]] = {}
    capture = read_shot(folder, rig, faults, files, pixels_most=pixels_most, lost=lost)
    losses = judge_lost(lost, rig, faults)
    if faults:
        raise InputError("capture", say_once(faults, rig.names))
    digests = dict(capture.digests)
    for path in rig_file_parts(rig_file):
        digests[path.relative_to(folder).as_posix()] = sha256_of(path)
    if has_known_length(folder):
        digests[SCALE] = sha256_of(entry(folder, SCALE))
    ordered = dict(sorted(digests.items()))
    unread = [*unread_files(folder, rigs), *unread_pictures(folder, files, rig)]
    remarks = [*losses, *capture.remarks, *read.remarks, *unread]
    kept = rig.subset([name for name in rig.names if name not in lost])
    return replace(capture, digests=ordered, remarks=tuple(remarks)), work_rig(kept, pixels_most)


def judge_lost(lost: Mapping[str, Sequence[Message]], rig: Rig, faults: list[Message]) -> list[Message]:
    """Returns a warning for each camera with unusable pictures; ``lost`` holds the reasons by camera. If too few other
    cameras remain, appends the reasons to ``faults``."""
    left, needed = len(rig) - len(lost), max(CAMERAS_LEAST, ceil(REST_LEAST * len(rig)))
    if left < needed:
        faults += [fault for of_camera in lost.values() for fault in of_camera]
        if left >= CAMERAS_LEAST:
            faults.append(compose("cameras-too-few-left", left=left, count=len(rig), needed=needed))
        return []
    return [compose("picture-lost", camera=name, faults=of_camera) for name, of_camera in lost.items()]


def open_capture(folder: Path) -> tuple[list[Path], CamerasRead, ShotFiles, list[Message]]:
    """Returns a capture folder's camera files (only the first is read), its cameras, the files of the shot, and all
    faults. Raises InputError if no cameras can be read."""
    rigs = [*rig_files(folder)]
    if not rigs:
        raise InputError("capture", [no_rig_fault(folder)])
    read = read_rig_of(rigs[0])
    check_folders(folder, read.rig)
    judged = rig_faults(read.rig, any_unit=has_known_length(folder))
    files = find_files(folder, read.rig, read.left_out)
    faults = [compose("located", where=rigs[0].name, fault=fault) for fault in judged]
    elsewhere = unread_folders(folder, files, read.rig) if files.faults else []  # perhaps they are there
    return rigs, read, files, [*faults, *files.faults, *elsewhere]


def read_rig_of(rig_file: Path) -> CamerasRead:
    """Reads the cameras of a capture. Raises an InputError whose faults name the file."""
    try:
        return read_cameras(rig_file)
    except InputError as error:
        raise InputError("capture", [f"{error.subject}: {fault}" for fault in error.faults]) from error


def unread_pictures(folder: Path, files: ShotFiles, rig: Rig) -> list[Message]:
    """Returns warnings about pictures that belong to no camera, and about folders of pictures that are not read."""
    remarks = [stray_sentence(files.strays, rig)] if files.strays else []
    return [compose("file-unread", remark=message) for message in [*remarks, *unread_folders(folder, files, rig)]]


def unread_folders(folder: Path, files: ShotFiles, rig: Rig) -> list[Message]:
    """Returns warnings about folders that contain pictures but are not read."""
    remarks: list[Message] = []
    known = ("images", *BESIDE_PICTURES, TEXTURE_SETS, *rig.names)
    for path in sorted(folder.iterdir()):
        is_other = path.is_dir() and not {path.name, path.name.lower()} & {*known} and not is_junk(path.name)
        used = any(file.is_relative_to(path) for name in rig.names for _, file in files.of_camera(name))
        shows = is_other and any(map(listed_pictures, (path, *sorted(path.iterdir()))))
        if shows and not used and not (path / "report.json").is_file():
            remarks.append(compose("folder-unread", folder=path.name))
    return remarks


def unread_files(folder: Path, rigs: Sequence[Path]) -> list[Message]:
    """Returns warnings about camera files in the folder that are not read: files of unsupported programs, and all but
    the first of ``rigs``. If ``rigs`` is empty, warns about all files except pictures and notes."""
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path not in rigs]
    if rigs:
        read, *others = (path.relative_to(folder).as_posix() for path in rigs)
        others += [*_other_models(folder, rigs[0]), *(path.name for path in files if program_of(path))]
        remarks = [compose("cameras-unread", file=other, read=read) for other in others]
    else:
        known = {SCALE, FEATURES, "calibration.json"}
        others = [path for path in files if not (shows_something(path) or is_junk(path.name) or program_of(path))]
        strange = [path.name for path in others if path.suffix.lower() not in NOTES and path.name.lower() not in known]
        remarks = unread_programs(folder)
        for inner in (path for path in sorted(folder.iterdir()) if path.is_dir() and not is_junk(path.name)):
            if not any((inner / of_a_result).is_file() for of_a_result in ("report.json", "calibration.json")):
                remarks += unread_programs(inner)
                if file := find_rig_file(inner):
                    remarks.append(compose("cameras-in-folder", file=file.relative_to(folder).as_posix()))
        remarks += [compose("cameras-of-nobody", files=some_of(strange))] if strange else []
    return [compose("file-unread", remark=message) for message in remarks]


def _other_models(folder: Path, rig_file: Path) -> list[str]:
    """Returns the files of further COLMAP models: text beside binary, and models of separately registered images."""
    if rig_file.suffix not in (".bin", ".txt"):
        return []
    twin = entry(rig_file.parent, "cameras.txt" if rig_file.suffix == ".bin" else "cameras.bin")
    sparse = sorted((folder / "sparse").glob("*/cameras.*")) if (folder / "sparse").is_dir() else []
    found = [twin] if twin.is_file() else []
    found += [path for path in sparse if path.suffix in (".bin", ".txt") and path.parent != rig_file.parent]
    return [path.relative_to(folder).as_posix() for path in found]


def has_known_length(folder: Path) -> bool:
    """Returns whether scale.json determines the unit of the cameras. With calibration.json, the unit is known."""
    return entry(folder, SCALE).is_file() and not (folder / "calibration.json").is_file()


def capture_root(folder: Path) -> Path:
    """Returns the folder of the capture: ``folder`` without the enclosing folders that archives often add.

    Raises InputError if ``folder`` is no folder."""
    if not folder.is_dir():
        raise InputError(str(folder.name or folder), [compose("no-capture-folder")])
    for _ in range(ENCLOSING_MOST):
        entries = [entry for entry in folder.iterdir() if not is_junk(entry.name)]
        if len(entries) != 1 or not entries[0].is_dir() or entries[0].name.lower() == "sparse":
            break
        folder = entries[0]
        if folder.name.lower() in ("images", *BESIDE_PICTURES):
            break
    return folder


def check_folders(folder: Path, rig: Rig) -> None:
    """Raises InputError for folders with names similar to those of the format, such as "backgrounds".

    If a misnamed folder were ignored, clean plates or all pictures would be missing."""
    kinds = ("images", *BESIDE_PICTURES)
    folders = [path.name for path in sorted(folder.iterdir()) if path.is_dir()]
    others = {name.casefold(): name for name in folders if not {name, name.lower()} & {*kinds, *rig.names}}
    faults = []
    for kind in kinds:
        alike = suggest(kind, others, min_likeness=ALIKE_LEAST)
        if alike and not entry(folder, kind).is_dir():
            faults.append(compose("folder-misnamed", folder=others[alike[0]], name=kind))
    alike = suggest(TEXTURE_SETS, others, min_likeness=SETS_ALIKE)
    if alike and not entry(folder, TEXTURE_SETS).is_dir():
        faults.append(compose("folder-misnamed", folder=others[alike[0]], name=TEXTURE_SETS))
    if faults:
        raise InputError("capture", faults)


def read_shot(
    folder: Path,
    rig: Rig,
    faults: list[Message],
    files: ShotFiles | None = None,
    *,
    pixels_most: int | None = None,
    with_features: bool = True,
    with_cut_outs: bool = True,
    lost: dict[str, list[Message]] | None = None,
) -> Capture:
    """Reads the pictures of a folder for a known rig, reduced to ``pixels_most`` pixels and undistorted.

    Appends every fault to ``faults``, except the faults in ``files``. If ``lost`` is not None, reasons for unusable
    pictures, masks and plates are recorded there by camera, and all pictures of such a camera are omitted."""
    if files is None:
        files = find_files(folder, rig)
        faults += files.faults
    for name, fault in files.absent.items():
        if name in rig:
            (faults if lost is None else lost.setdefault(name, [])).append(fault)
    jobs = [(kind, camera.name, path) for camera in rig for kind, path in files.of_camera(camera.name)]
    bits, levels = _sample_bits(jobs, faults)
    pictures, digests = _decoded(folder, jobs, rig, faults, lost, pixels_most=pixels_most, bits=bits)
    images = {name: pixels for name, _, pixels in pictures.get("images", ())}
    masks = {name: (where, pixels) for name, where, pixels in pictures.get("masks", ())}
    backgrounds: dict[str, list[np.ndarray]] = {}
    for name, _, pixels in pictures.get("background", ()):
        backgrounds.setdefault(name, []).append(pixels)
    sets = {
        kind.removeprefix(f"{TEXTURE_SETS}/"): {name: pixels for name, _, pixels in of_set}
        for kind, of_set in pictures.items()
        if kind.startswith(TEXTURE_SETS)
    }
    subjects = mask_subjects(masks, rig, faults, pixels_most=pixels_most, lost=lost)
    for of_kind in (images, backgrounds, *sets.values()):
        for name in of_kind.keys() & (lost or {}).keys():
            del of_kind[name]
    features: Features = {}
    if with_features and entry(folder, FEATURES).is_file():
        data = entry(folder, FEATURES).read_bytes()
        digests[FEATURES] = hashlib.sha256(data).hexdigest()
        features = _in_read_pictures(features_from_bytes(data, rig, faults), rig)
        features = {
            point: {n: at for n, at in of.items() if not lost or n not in lost} for point, of in features.items()
        }
        features = work_features(features, rig, work_rig(rig, pixels_most))
    if with_cut_outs and images and not masks and not backgrounds and len(images) + len(lost or ()) == len(rig):
        subjects = _cut_outs(folder, [job for job in jobs if job[1] in images], rig, pixels_most) or subjects
    shown, plates, rims = fill_rims(images, backgrounds, subjects.masks)
    return Capture(
        shown,
        plates,
        subjects.masks,
        features,
        digests,
        (*levels, *_page_remarks(folder, jobs), *_grey_remarks(images), *rims, *subjects.remarks),
        subjects.soft,
        sets,
    )


def _decoded(
    folder: Path,
    jobs: Sequence[tuple[str, str, Path]],
    rig: Rig,
    faults: list[Message],
    lost: dict[str, list[Message]] | None,
    *,
    pixels_most: int | None,
    bits: Mapping[str, int],
) -> tuple[dict[str, list[tuple[str, str, np.ndarray]]], dict[str, str]]:
    """Returns camera, file and pixels of every readable picture by kind, and the SHA-256 of each file."""

    def decode(job: tuple[str, str, Path]) -> tuple[np.ndarray | None, str, Message | None]:
        return decode_picture(folder, *job, rig=rig, pixels_most=pixels_most, bits=bits[job[0]])

    with ThreadPoolExecutor(max_workers=4) as pool:  # cv2 decodes outside the interpreter lock
        decoded = list(pool.map(decode, jobs))
    pictures: dict[str, list[tuple[str, str, np.ndarray]]] = {}
    digests: dict[str, str] = {}
    for (kind, name, path), (pixels, digest, fault) in zip(jobs, decoded, strict=True):
        where = path.relative_to(folder).as_posix()
        if pixels is None:
            assert fault is not None
            of_set = kind.startswith(TEXTURE_SETS)
            (faults if lost is None or of_set else lost.setdefault(name, [])).append(fault)
            continue
        digests[where] = digest
        pictures.setdefault(kind, []).append((name, where, pixels))
    if lost:
        pictures = {kind: [one for one in of_kind if one[0] not in lost] for kind, of_kind in pictures.items()}
    return pictures, digests


def _cut_outs(
    folder: Path, jobs: Sequence[tuple[str, str, Path]], rig: Rig, pixels_most: int | None
) -> MaskSubjects | None:
    """Returns masks from the alpha channels, if every picture has a transparent background.

    Returns None, and no fault, if any picture is opaque or its alpha channel is no valid mask."""
    found = {}
    for _, name, path in (job for job in jobs if job[0] == "images"):
        alpha, k = cut_out_alpha(path), rig[name].intrinsics
        if alpha is None or alpha.shape != (k.height, k.width):
            return None
        found[name] = path.relative_to(folder).as_posix(), alpha
    unfit: list[Message] = []
    subjects = mask_subjects(found, rig, unfit, pixels_most=pixels_most)
    return None if unfit else replace(subjects, remarks=(*subjects.remarks, compose("masks-of-alpha")))


def _sample_bits(
    jobs: Sequence[tuple[str, str, Path]], faults: list[Message]
) -> tuple[Mapping[str, int], list[Message]]:
    """Returns the number of used bits in 16-bit files by kind of file, and a warning if not all bits are used. Appends
    a fault for picture files with a raw sensor mosaic."""
    kinds = [*dict.fromkeys(("images", "background", *(kind for kind, _, _ in jobs if kind != "masks")))]
    samples = {kind: measure_samples([path for of, _, path in jobs if of == kind]) for kind in kinds}
    mosaics = [f"{kind}/" for kind in kinds if samples[kind].mosaic]
    if mosaics:
        faults.append(compose("pictures-are-mosaics", folders=mosaics))
    bits = {kind: samples[kind].bits or WHOLE_BITS for kind in kinds} | {"masks": WHOLE_BITS}
    remarks = []
    for used in sorted({bits[kind] for kind in kinds} - {WHOLE_BITS}):
        folders = [f"{kind}/" for kind in kinds if bits[kind] == used]
        remarks.append(compose("picture-levels", folders=folders, most=2**used - 1, bits=used, shift=WHOLE_BITS - used))
    return bits, remarks


def _page_remarks(folder: Path, jobs: Sequence[tuple[str, str, Path]]) -> list[Message]:
    """Returns a warning about files that contain several pictures, because only the first is read."""
    paged = [path.relative_to(folder).as_posix() for _, _, path in jobs if page_count(path) > 1]
    if not paged:
        return []
    return [compose("file-unread", remark=compose("pages-unread", count=len(paged), pictures=some_of(paged)))]


def _grey_remarks(images: Mapping[str, np.ndarray]) -> list[Message]:
    """Returns a warning if some pictures are grey and others are in colour."""
    grey = [name for name, image in images.items() if is_grey(image)]
    return [compose("pictures-grey", cameras=some_of(grey))] if 0 < len(grey) < len(images) else []


def write_capture(folder: Path, capture: Capture, rig: Rig) -> None:
    """Writes a capture folder of PNG files atomically. ``rig`` holds the cameras of the pictures."""
    write_rig(rig, folder / "cameras.json")
    files: list[tuple[Path, np.ndarray]] = []
    for name, image in capture.images.items():
        files.append((folder / "images" / f"{name}.png", image))
    for name, plates in capture.backgrounds.items():
        several = len(plates) > 1
        for i, plate in enumerate(plates):
            files.append((folder / "background" / (f"{name}/{i:03}.png" if several else f"{name}.png"), plate))
    for name, mask in capture.masks.items():
        share = capture.soft_masks.get(name, mask.astype(np.uint8) * np.uint8(255))
        files.append((folder / "masks" / f"{name}.png", share))
    for kind, images in capture.texture_sets.items():
        files += [(folder / TEXTURE_SETS / kind / f"{name}.png", image) for name, image in images.items()]
    with ThreadPoolExecutor(max_workers=4) as pool:
        list(pool.map(lambda file: write_image(*file), files))
    if capture.features:
        text = json.dumps(document_from_features(capture.features), indent=1)
        write_atomically(folder / "features.json", text.encode())


def _in_read_pictures(features: Features, rig: Rig) -> Features:
    """Converts feature points from the pictures in the files to the undistorted pictures in memory."""

    def moved(name: str, pixel: np.ndarray) -> np.ndarray:
        lens = rig[name].recorded
        return pixel if lens is None else lens.undistorted(pixel[None], rig[name].intrinsics.matrix())[0]

    return {point: {name: moved(name, at) for name, at in views.items()} for point, views in features.items()}


def decode_picture(
    folder: Path, kind: str, name: str, path: Path, *, rig: Rig, pixels_most: int | None, bits: int
) -> tuple[np.ndarray | None, str, Message | None]:
    """Decodes, reduces and undistorts a picture file of camera ``name``. Returns the picture's pixels and the file's
    SHA-256, or a fault if the file is damaged. ``kind`` is images, background, masks or a texture set's folder."""
    camera = rig[name]
    wanted, share = (camera.intrinsics.width, camera.intrinsics.height), work_share(camera.intrinsics, pixels_most)
    where, whole = path.relative_to(folder).as_posix(), kind == "masks"
    pixels, digest, fault = decode_image_file(
        path, where, "mask" if whole else "colour", share=1.0 if whole else share, bits=bits
    )
    if pixels is None:
        return None, digest, fault
    size = (pixels.shape[1], pixels.shape[0]) if whole or share == 1.0 else picture_size(path)
    if size != wanted:
        differs = size_fault(where, size, camera.intrinsics)
        pages = page_count(path)
        return None, "", differs if pages == 1 else compose("first-page-differs", fault=differs, pages=pages)
    if kind == "images" and np.mean(pixels[::4, ::4] > BLACK) < LIT_LEAST:
        return None, "", compose("of-file", file=where, fault=compose("picture-black"))
    if whole:  # masks are interpreted together, and before pixels are averaged
        return pixels, digest, fault
    if camera.recorded is not None:
        matrix = work_rig(rig.subset([name]), pixels_most)[name].intrinsics.matrix()
        pixels = camera.recorded.undistort(pixels, matrix)
    pixels.setflags(write=False)
    return pixels, digest, fault


def size_fault(where: str, size: tuple[int, int], k: Intrinsics) -> Message:
    """Returns a fault that reports a picture whose size (width, height) differs from that of the camera."""
    of_picture, of_camera = f"{size[0]} x {size[1]}", f"{k.width} x {k.height}"
    fault = compose("picture-size-differs", picture=where, size=of_picture, wanted=of_camera)
    if size == (k.height, k.width):
        as_told, turned = (abs(k.cx - w / 2) + abs(k.cy - h / 2) for w, h in ((k.width, k.height), size))
        if turned < as_told:
            return compose("located", where=fault, fault=compose("size-exchanged"))
        return compose("located", where=fault, fault=compose("picture-turned"))
    share = size[0] / k.width
    if abs(size[1] - share * k.height) <= 1.0:
        return compose("picture-scaled", fault=fault)
    return fault


def full_size_reader(folder: Path, rig: Rig, left_out: Sequence[str] = ()) -> ReadImage:
    """Returns a function that reads and undistorts the picture of a camera at full size. ``folder`` is the capture's
    folder. ``left_out`` lists cameras that are in the capture's camera file but not in ``rig``."""
    files = find_files(folder, rig, left_out)
    paths = {name: path for name in rig.names for kind, path in files.of_camera(name) if kind == "images"}
    bits = measure_samples([*paths.values()]).bits or WHOLE_BITS

    def read(name: str) -> ImageRgb:
        if name not in paths:
            raise InputError("capture", [compose("picture-gone", camera=name)])
        pixels, _, fault = decode_picture(folder, "images", name, paths[name], rig=rig, pixels_most=None, bits=bits)
        if pixels is None:
            assert fault is not None, "no pixels without a fault"
            raise InputError("capture", [fault])
        return pixels

    return read
