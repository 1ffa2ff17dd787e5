"""Reads and writes rigs in the file formats of other programs.

The module reads and writes COLMAP (text and binary), caliscope's ``camera_array.toml``, aniposelib's TOML, Metashape's
XML, RealityCapture's XMP and CSV, nerfstudio's ``transforms.json`` and OpenCV's YAML. The module also writes a script
for Blender. Every reader converts its file to an ``eigenhead-cameras/1`` document, and ``rig_from_document`` checks the
documents of all formats alike. The module of each format cites a description of the file's layout.

In this project and OpenCV the centre of the top-left pixel is (0, 0); in COLMAP, Metashape, RealityCapture and
nerfstudio it is (0.5, 0.5). Readers of camera files convert lengths to millimetres. Files of caliscope, Metashape and
RealityCapture are in metres. COLMAP's arbitrary unit is taken as millimetres. In files of aniposelib, nerfstudio and
OpenCV, the distances between the cameras determine the unit. Gaussian splatting's ``cameras.json`` and NeRSemble's
``camera_params.json`` are also read.

An unread key of ``cameras.json``, such as a misspelt ``covarianse`` or a ``k4`` that the lens model lacks, is no fault,
because files may contain keys for other programs. A warning says that such a key has no effect.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rig.errors import InputError
from rig.formats.cameras.blender_script import write_blender
from rig.formats.cameras.cameras_json import (
    CAMERAS_LEAST,
    CAMERAS_MOST,
    FORMAT,
    read_document,
    rig_from_document,
    write_rig,
)
from rig.formats.cameras.colmap import read_colmap, write_colmap
from rig.formats.cameras.foreign import CamerasRead, head_of, program_of, unread_programs
from rig.formats.cameras.metashape import read_metashape, write_metashape
from rig.formats.cameras.opencv_yaml import (
    looks_like_aniposelib,
    read_toml,
    read_yaml,
    write_aniposelib,
    write_caliscope,
    write_yaml,
)
from rig.formats.cameras.realitycapture import looks_like_csv, read_csv, read_xmp, write_csv, write_xmp
from rig.formats.cameras.transforms_json import read_nersemble, read_splatting, read_transforms, write_transforms
from rig.formats.pictures.picture_names import entry, is_junk
from rig.messages.message import Message, compose, some_of
from rig.recorded_lens import COEFFICIENTS
from rig.rig import Rig, spread_views

READ = {
    "": {"format", "unit", "cameras", "scale_sigma"},
    "cameras": {"name", "width", "height", "intrinsics", "distortion", "camera_from_world", "covariance", "serial"},
    "cameras.intrinsics": {"fx", "fy", "cx", "cy"},
    "cameras.camera_from_world": {"rotation", "translation"},
}
LENS_MODELS: dict[str, set[str]] = {
    "brown-conrady": {"model", "k1", "k2", "p1", "p2", "k3", "skew"},
    **{model: {"model", "skew", *keys} for model, keys in COEFFICIENTS.items()},
}
OWN = r"\A\W*format\W+eigenhead-cameras/"  # with which a cameras.json begins, whatever its name
CHUNK = r"<chunk\b"  # in Metashape's XML
TOLD_MOST = 8  # keys named one by one; the others are counted

WRITERS: dict[str, Callable[[Rig, Path], None]] = {
    "eigenhead": write_rig,
    "colmap": lambda rig, folder: write_colmap(rig, folder, binary=True),
    "colmap-text": write_colmap,
    "caliscope": write_caliscope,
    "aniposelib": write_aniposelib,
    "metashape": write_metashape,
    "realitycapture": write_xmp,
    "realitycapture-csv": write_csv,
    "nerfstudio": write_transforms,
    "opencv-yaml": write_yaml,
    "blender": write_blender,
}
FORMATS = tuple(WRITERS)
FOLDER_FORMATS = ("colmap", "colmap-text", "realitycapture", "opencv-yaml")  # formats of several files
NO_RIG = compose("no-rig-file")
ARCHIVE_ENDINGS = (".zip", ".tar", ".tgz", ".gz", ".xz", ".bz2", ".7z", ".rar")
JSON_READERS: tuple[tuple[Callable[[Any], bool], Callable[[Any, Path], CamerasRead]], ...] = (
    (lambda document: isinstance(document, dict) and "frames" in document, read_transforms),
    (lambda document: isinstance(document, list) and _are_of_splatting(document), read_splatting),
    (lambda document: isinstance(document, dict) and "world_2_cam" in document, read_nersemble),
)


def _are_of_splatting(entries: list[Any]) -> bool:
    wanted = {"img_name", "position", "rotation", "fx"}
    return bool(entries) and all(isinstance(entry, dict) and wanted <= entry.keys() for entry in entries)


def no_rig_fault(folder: Path) -> Message:
    """Returns a fault that reports a folder without a file of cameras. The returned fault names any captures, archives,
    or files of unsupported programs in the folder."""
    if elsewhere := misplaced_fault(folder) or next(iter(unread_programs(folder)), None):
        return elsewhere
    archives = [path.name for path in sorted(folder.iterdir()) if path.name.lower().endswith(ARCHIVE_ENDINGS)]
    if archives:
        return compose("archives-inside", archives=some_of(archives))
    inner = sorted(path for path in folder.iterdir() if path.is_dir() and not is_junk(path.name))
    captures = [path.name for path in inner if path.suffix != ".truth" and find_rig_file(path)]
    return compose("captures-inside", captures=some_of(captures)) if len(captures) > 1 else NO_RIG


def misplaced_fault(folder: Path) -> Message | None:
    """Returns the fault of pictures that are no capture: those of a calibration board, or a capture's images/ alone."""
    if entry(folder, "board.toml").is_file():
        return compose("board-pictures")
    name, above = folder.absolute().name, folder.absolute().parent
    is_part = name.lower() == "images" and find_rig_file(above) is not None
    return compose("capture-above", folder=above.name) if is_part else None


def find_rig_file(folder: Path) -> Path | None:
    """Returns the path of the file in ``folder`` that holds the rig, or None without such a file."""
    return next(rig_files(folder), None)


def rig_files(folder: Path) -> Iterator[Path]:
    """Yields the files in ``folder`` that may hold the rig, at most one for each program, the best one first.

    The order of the files is: ``cameras.json``; a COLMAP model (``cameras.bin`` or ``.txt``) in ``sparse/0``,
    ``sparse`` or ``folder``; ``camera_array.toml``; another TOML file with aniposelib's keys; ``transforms.json``;
    ``intri.yml``; another YAML file of OpenCV with a key ``K_<camera>``; an XML file of Metashape; XMP files of
    RealityCapture beside the pictures or in ``folder``, or its CSV; a file like ``cameras.json`` with another name.
    """
    here = [path for path in sorted(folder.iterdir()) if path.is_file() and not is_junk(path.name)]
    images = entry(folder, "images")
    beside = [path for path in sorted(images.iterdir()) if path.is_file()] if images.is_dir() else []
    names = ("cameras.json", "camera_array.toml", "transforms.json", "camera_params.json", "intri.yml")
    native, caliscope, nerfstudio, nersemble, easymocap = (entry(folder, name) for name in names)
    models = [entry(folder, "sparse"), folder]
    models = [entry(models[0], "0"), *models]
    colmap = [entry(model, f"cameras{end}") for model in models for end in (".bin", ".txt")]

    def of(*endings: str, mark: str = "", among: Sequence[Path] = here) -> list[Path]:
        ending = [path for path in among if path.suffix.lower() in endings and path not in (caliscope, easymocap)]
        return [path for path in ending if not mark or re.search(mark, head_of(path))]

    for found in (
        [native],
        colmap,
        [caliscope],
        (path for path in of(".toml") if looks_like_aniposelib(path)),
        [nerfstudio],
        [nersemble],
        [easymocap],
        of(".yml", ".yaml", mark=r"\nK_"),
        of(".xml", mark=CHUNK),
        of(".xmp", mark="capturingreality", among=[*beside, *here]),
        (path for path in of(".csv") if looks_like_csv(head_of(path))),
        (path for path in of(".json", ".txt", mark=OWN) if path != native),  # "cameras (1).json", "cameras.json.txt"
    ):
        first = next((path for path in found if path.is_file() or path.is_symlink()), None)  # a broken link is told
        if first is not None:
            yield first


def read_rig_file(path: Path) -> Rig:
    """Returns the rig in a file of any known format. Raises InputError naming every fault."""
    return read_cameras(path).rig


def read_cameras(path: Path) -> CamerasRead:
    """Returns the rig in a file of any known format, with warnings. Raises InputError naming every fault."""
    suffix = path.suffix.lower()
    readers = {
        **{".json": _read_json, ".toml": read_toml, ".xml": read_metashape, ".csv": read_csv},
        **{".yml": read_yaml, ".yaml": read_yaml, ".bin": read_colmap, ".txt": read_colmap, ".xmp": read_xmp},
    }
    try:
        if suffix not in readers:
            raise InputError(path.name, [compose("no-rig-ending", endings=[*readers], formats=FORMATS[:-1])])
        if path.is_symlink() and not path.exists():
            fault = compose("picture-link-broken", picture=path.name, target=str(path.readlink()))
            raise InputError(path.name, [fault])
        head = head_of(path)
        contents = ((re.search(OWN, head), _read_json), (re.search(CHUNK, head), read_metashape))
        reader = next((read for fits, read in contents if fits), readers[suffix])
        reader = read_csv if looks_like_csv(head) else reader
        return _thinned(reader(path), path.name)
    except InputError:
        if (program := program_of(path)) is None:
            raise
        raise InputError(path.name, [compose("cameras-of-program", files=[path.name], program=program)]) from None


def _read_json(path: Path) -> CamerasRead:
    """Reads the cameras of a JSON file, in the format that its content indicates."""
    document = read_document(path)
    reader = next((read for is_of, read in JSON_READERS if is_of(document)), None)
    if reader is not None:
        return reader(document, path)
    remarks = [compose("unknown-key", remark=remark) for remark in unread_keys_of(document, path.name)]
    entries = document.get("cameras") if isinstance(document, dict) else None
    entries = entries if isinstance(entries, list) else []
    posed = [entry for entry in entries if not isinstance(entry, dict) or entry.get("camera_from_world") is not None]
    if len(posed) == len(entries) or len(posed) < CAMERAS_LEAST:
        return CamerasRead(rig_from_document(document, path.name), tuple(remarks))
    why, lenses = (
        compose("left-without-pose"),
        [f"{entry.get('name')!s:.64}" for entry in entries if entry not in posed],
    )
    sentence = compose("cameras-left-out", cameras=some_of(lenses), why=why, file=path.name)
    remarks.append(compose("view-left-out", remark=sentence))
    rig = rig_from_document({**document, "cameras": posed}, path.name)
    return CamerasRead(rig, tuple(remarks), dict.fromkeys(lenses, why))


def _thinned(read: CamerasRead, file: str) -> CamerasRead:
    """Keeps at most ``CAMERAS_MOST`` cameras with widely different views."""
    if len(read.rig) <= CAMERAS_MOST:
        return read
    kept = set(spread_views(read.rig, CAMERAS_MOST))
    rig = read.rig.subset([name for name in read.rig.names if name in kept])
    why = compose("left-of-many", count=len(read.rig), most=CAMERAS_MOST)
    others = [name for name in read.rig.names if name not in kept]
    sentence = compose("cameras-left-out", cameras=some_of(others), why=why, file=file)
    remarks = (*read.remarks, compose("view-left-out", remark=sentence))
    return CamerasRead(rig, remarks, {**read.left_out, **dict.fromkeys(others, why)})


def rig_file_parts(path: Path) -> tuple[Path, ...]:
    """Returns all files that ``read_rig_file`` reads for ``path``, because some formats have several."""
    if path.suffix.lower() == ".xmp":
        return tuple(other for other in sorted(path.parent.iterdir()) if other.suffix.lower() == ".xmp")
    pairs = {"cameras.bin": "images.bin", "cameras.txt": "images.txt", "intri.yml": "extri.yml"}
    other = pairs.get(path.name.lower())  # a cameras.txt that holds JSON has none
    return (path, entry(path.parent, other)) if other and entry(path.parent, other).is_file() else (path,)


def write_rig_file(rig: Rig, path: Path, kind: str) -> None:
    """Writes a rig in the format ``kind``. For a kind in ``FOLDER_FORMATS``, ``path`` is a folder. Raises InputError
    for a kind that is not in ``FORMATS``."""
    if kind not in WRITERS:
        raise InputError("format", [compose("none-of", value=f"{kind!r}", known=FORMATS)])
    skewed = [camera.name for camera in rig if camera.recorded is not None and camera.recorded.skew]
    if skewed and kind != "eigenhead":
        raise InputError(kind, [compose("format-without-skew", cameras=some_of(skewed))])
    WRITERS[kind](rig, path)


def unread_keys_of(document: Any, subject: str = "cameras.json") -> tuple[Message, ...]:
    """Returns messages about the unread keys of a decoded ``cameras.json``. An unread key of many cameras gets one
    message, with the number of cameras."""
    counts = Counter(_unread(document))
    faults = []
    for (place, key), times in list(counts.items())[:TOLD_MOST]:
        where = repr(f"{place}.{key}" if place else key)  # repr, since the key may contain unprintable characters
        faults.append(compose("key-unread", count=times, key=f"{where:.80}"))
    if len(counts) > TOLD_MOST:
        faults.append(compose("keys-unread-more", more=len(counts) - TOLD_MOST))
    return tuple(compose("located", where=subject, fault=fault) for fault in faults)


def _unread(document: Any) -> Iterator[tuple[str, str]]:
    """Yields the location and name of each unread key."""
    if not isinstance(document, Mapping) or document.get("format") != FORMAT:
        return
    cameras, tables = document.get("cameras"), list[tuple[str, Any]]([("", document)])
    for camera in cameras if isinstance(cameras, list) else []:
        inner = ("intrinsics", "camera_from_world", "distortion") if isinstance(camera, Mapping) else ()
        tables += [("cameras", camera), *((f"cameras.{key}", camera.get(key)) for key in inner)]
    for place, table in tables:
        if isinstance(table, Mapping):
            lens = LENS_MODELS.get(str(table.get("model", "brown-conrady")), set(table))  # others are refused
            yield from ((place, key) for key in table if key not in READ.get(place, lens))
