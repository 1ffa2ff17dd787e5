"""Stores clean plates, which are pictures of the empty studio, for each camera in a folder beside rig.toml.

    plates/<camera>/000.png ...     (or plates/<camera>.png: what a capture folder's background/ holds is accepted too)
    plates/plates.json              when they were taken, the noise of each camera
    plates.versions/<version>/...   those that were in use before, and those that were refused

The program keeps one plate of each camera in memory. A capture folder gets links to the files of all plates.
"""

import json
import os
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from rig.acquisition.image_checks import noise_of
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.pictures.images import IMAGE_SUFFIXES, read_image, write_image
from rig.image import ImageRgb
from rig.messages.message import Message, compose, documents_of, read_message

FORMAT = "eigenhead-plates/1"
VERSIONS_MOST = 6  # the one in use and refused ones included
UNFINISHED_S = 3600.0  # no version takes so long to write


@dataclass(frozen=True, slots=True, eq=False)
class Plates:
    """Holds the clean plates by camera: files, the first plate as an image, and the noise (standard deviation of the
    values, 0 to 255). The noise is None if a camera has a single plate."""

    files: Mapping[str, tuple[Path, ...]]
    first: Mapping[str, ImageRgb]
    noise: Mapping[str, float | None]
    taken: str | None  # UTC, ISO 8601; None of plates that came from elsewhere

    def __contains__(self, camera: object) -> bool:
        return camera in self.first


NO_PLATES = Plates({}, {}, {}, None)


def read_plates(folder: Path, names: tuple[str, ...]) -> Plates:
    """Reads the clean plates in ``folder`` for those of the cameras that have any. Raises InputError for a file that is
    no picture."""
    files = {name: paths for name in names if (paths := _files(folder, name))}
    with ThreadPoolExecutor(4) as pool:
        first = dict(zip(files, pool.map(lambda paths: read_image(paths[0]), files.values()), strict=True))
    noise: dict[str, float | None] = dict.fromkeys(files)
    taken = None
    try:
        document = json.loads((folder / "plates.json").read_text(encoding="utf-8"))
        taken = str(document["taken"])
        noise |= {name: value for name, value in document["noise"].items() if name in files}
    except OSError:
        pass  # plates of a recorded capture
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("plates.json", [compose("plates-file-damaged", reason=str(error))]) from error
    return Plates(files, first, noise, taken)


@dataclass(frozen=True, slots=True)
class PlatesVersion:
    """Describes a stored set of clean plates. ``taken`` is the UTC time in ISO 8601; ``refused`` lists the faults for
    which the plates were refused."""

    id: str
    taken: str
    cameras: tuple[str, ...]
    refused: tuple[Message, ...]
    in_use: bool


def write_plates(folder: Path, images: Mapping[str, tuple[ImageRgb, ...]]) -> Plates:
    """Writes new clean plates to ``folder``. When the new plates are complete, the old ones become a version."""
    return use_plates(folder, keep_plates(folder, images), tuple(images))


def keep_plates(folder: Path, images: Mapping[str, tuple[ImageRgb, ...]], refused: tuple[Message, ...] = ()) -> str:
    """Writes clean plates as a version that is not in use, and returns the version's id. ``refused`` lists the faults
    that prevent the use of these clean plates."""
    moment = datetime.now(UTC)
    identity = moment.strftime("%Y%m%dT%H%M%S%fZ")
    _remove_unfinished(folder)
    fresh = _versions(folder) / f"{identity}.new"
    targets = [
        (fresh / name / f"{i:03}.png", plate) for name, plates in images.items() for i, plate in enumerate(plates)
    ]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda target: write_image(*target), targets))
        noise = dict(zip(images, pool.map(noise_of, images.values()), strict=True))
    taken = moment.isoformat(timespec="seconds")
    document = {"format": FORMAT, "id": identity, "taken": taken, "noise": noise, "refused": documents_of(refused)}
    write_atomically(fresh / "plates.json", json.dumps(document, indent=1).encode())
    fresh.rename(fresh.with_suffix(""))
    _remove_old(folder)
    return identity


def use_plates(folder: Path, version: str, names: tuple[str, ...]) -> Plates:
    """Exchanges the clean plates in use for a stored version. Raises InputError for an unknown version."""
    wanted, stored = (_versions(folder) / version, {entry.id: entry for entry in plates_versions(folder)})
    if version in stored and stored[version].in_use:
        return read_plates(folder, names)
    if version not in stored:
        raise InputError("clean plates", [compose("plates-version-not-kept", version=f"{version!r:.40}")])
    if folder.exists():
        folder.rename(_versions(folder) / _version_of(folder).id)
    wanted.rename(folder)
    _remove_old(folder)
    with suppress(OSError):  # removed only if it is empty, as after the first plates
        _versions(folder).rmdir()
    return read_plates(folder, names)


def _remove_old(folder: Path) -> None:
    """Removes all stored versions but the newest ``VERSIONS_MOST``."""
    for old in plates_versions(folder)[VERSIONS_MOST:]:
        if not old.in_use:
            shutil.rmtree(_versions(folder) / old.id, ignore_errors=True)


def _remove_unfinished(folder: Path) -> None:
    """Removes incomplete versions whose writing process has ended."""
    for left in _versions(folder).glob("*.new"):
        if time.time() - left.stat().st_mtime > UNFINISHED_S:
            shutil.rmtree(left, ignore_errors=True)


def plates_versions(folder: Path) -> list[PlatesVersion]:
    """Returns the clean plates in use and the stored versions, newest first."""
    folders = [path for path in _versions(folder).glob("*Z") if path.is_dir()] if _versions(folder).is_dir() else []
    versions = [_version_of(path) for path in folders]
    if folder.is_dir():
        versions.append(replace(_version_of(folder), in_use=True))
    return sorted(versions, key=lambda version: version.id, reverse=True)


def _version_of(folder: Path) -> PlatesVersion:
    """Reads a version's description from plates.json, or without that file uses the folder's modification time."""
    try:
        document = json.loads((folder / "plates.json").read_text(encoding="utf-8"))
        taken = str(document["taken"])
        identity = str(document.get("id") or datetime.fromisoformat(taken).strftime("%Y%m%dT%H%M%S%fZ"))
        refused = tuple(map(read_message, document.get("refused", ())))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        moment = datetime.fromtimestamp(folder.stat().st_mtime, UTC)
        identity, taken, refused = moment.strftime("%Y%m%dT%H%M%S%fZ"), moment.isoformat(timespec="seconds"), ()
    cameras = sorted({path.stem for path in folder.iterdir() if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES})
    return PlatesVersion(identity, taken, tuple(cameras), refused, in_use=False)


def _versions(folder: Path) -> Path:
    return folder.with_name(folder.name + ".versions")


def link_plates(plates: Plates, background: Path) -> None:
    """Links the files of clean plates into the folder ``background`` of a capture, or copies them if it cannot link."""
    for name, files in plates.files.items():
        for i, file in enumerate(files):
            target = (
                background / name / f"{i:03}{file.suffix}" if len(files) > 1 else background / f"{name}{file.suffix}"
            )
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(file, target)
            except OSError:
                shutil.copyfile(file, target)


def _files(folder: Path, name: str) -> tuple[Path, ...]:
    if (folder / name).is_dir():
        return tuple(sorted(path for path in (folder / name).iterdir() if path.suffix.lower() in IMAGE_SUFFIXES))
    single = (folder / (name + suffix) for suffix in IMAGE_SUFFIXES)
    return tuple(path for path in single if path.is_file())[:1]
