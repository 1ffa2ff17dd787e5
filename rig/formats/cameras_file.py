"""Rigs in other programs' files: COLMAP (text and binary), caliscope's ``camera_array.toml``, aniposelib's TOML.

Every reader turns its file into the ``eigenhead-cameras/1`` document and lets ``rig_from_document`` judge it, so that
all formats meet the same checks. Sources of the layouts: https://colmap.github.io/format.html (with the parameter order
of ``src/colmap/sensor/models.h``), https://mprib.github.io/caliscope, https://anipose.readthedocs.io.

Pixels: COLMAP puts (0.5, 0.5) at the centre of the top-left pixel, this project (0, 0); the two TOML formats follow
OpenCV and need no shift. Lengths: caliscope is in metres; COLMAP's scale is free and taken as millimetres; aniposelib's
is that of its board, see ``_aniposelib_unit``.
"""

from collections.abc import Callable
from pathlib import Path

from rig.errors import InputError
from rig.formats.cameras_json import read_rig, write_rig
from rig.formats.colmap import read_colmap, write_colmap
from rig.formats.opencv_toml import looks_like_aniposelib, read_toml, write_aniposelib, write_caliscope
from rig.rig import Rig

FORMATS = ("eigenhead", "colmap", "colmap-text", "caliscope", "aniposelib")


COLMAP_FOLDERS = ("sparse/0", "sparse", ".")


def find_rig_file(folder: Path) -> Path | None:
    """The file in ``folder`` that holds the rig, for ``read_rig_file``; None if there is none.

    In this order: ``cameras.json``; a COLMAP model under ``sparse/0``, ``sparse`` or at the top (its ``cameras.bin`` or
    ``cameras.txt``); ``camera_array.toml``; any other TOML file with aniposelib's keys.
    """
    if (folder / "cameras.json").is_file():
        return folder / "cameras.json"
    for inner in COLMAP_FOLDERS:
        for suffix in (".bin", ".txt"):
            path = folder / inner / f"cameras{suffix}"
            if path.is_file():
                return path
    if (folder / "camera_array.toml").is_file():
        return folder / "camera_array.toml"
    return next((path for path in sorted(folder.glob("*.toml")) if looks_like_aniposelib(path)), None)


def read_rig_file(path: Path) -> Rig:
    """The rig in a file of any known format. Raises InputError naming every fault found in it."""
    if path.suffix == ".json":
        return read_rig(path)
    if path.suffix in (".bin", ".txt"):
        return read_colmap(path.parent, path.suffix)
    if path.suffix == ".toml":
        return read_toml(path)
    raise InputError(path.name, ["is no rig file: wanted cameras.json, COLMAP's cameras.txt or .bin, or a .toml"])


def rig_file_parts(path: Path) -> tuple[Path, ...]:
    """The files from which ``read_rig_file`` reads ``path``: of a COLMAP model two, of the other formats one."""
    return (path, path.with_stem("images")) if path.suffix in (".bin", ".txt") else (path,)


def write_rig_file(rig: Rig, path: Path, kind: str) -> None:
    """Writes a rig in a format of ``FORMATS``; COLMAP's are folders. Raises InputError for another format."""
    writers: dict[str, Callable[[Rig, Path], None]] = {
        "eigenhead": write_rig,
        "colmap": lambda rig, folder: write_colmap(rig, folder, binary=True),
        "colmap-text": write_colmap,
        "caliscope": write_caliscope,
        "aniposelib": write_aniposelib,
    }
    assert tuple(writers) == FORMATS
    if kind not in writers:
        raise InputError("format", [f"{kind!r} is none of {', '.join(FORMATS)}"])
    writers[kind](rig, path)
