"""Clean plates: pictures of the empty studio, several of each camera, kept beside rig.toml.

    plates/<camera>/000.png ...     (or plates/<camera>.png: what a capture folder's background/ holds is accepted too)
    plates/plates.json              when they were taken, the noise of each camera

A session needs one plate of each camera in memory; captures get links to the files.
"""

import json
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from rig.acquisition.image_checks import noise_of
from rig.acquisition.occupied import occupied
from rig.atomic_write import write_atomically
from rig.errors import InputError
from rig.formats.images import IMAGE_SUFFIXES, read_image, write_image

FORMAT = "eigenhead-plates/1"
ImageRgb = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Plates:
    """The files of each camera, the first of them as an image, and the noise (values; None of a single plate)."""

    files: Mapping[str, tuple[Path, ...]]
    first: Mapping[str, ImageRgb]
    noise: Mapping[str, float | None]
    taken: str | None  # UTC, ISO 8601; None of plates that came from elsewhere

    def __contains__(self, camera: object) -> bool:
        return camera in self.first


NO_PLATES = Plates({}, {}, {}, None)


def read_plates(folder: Path, names: tuple[str, ...]) -> Plates:
    """The plates of ``folder``; cameras without any are left out. Raises InputError for a file that is no picture."""
    files = {name: found for name in names if (found := _files(folder, name))}
    with ThreadPoolExecutor(4) as pool:
        first = dict(zip(files, pool.map(lambda found: read_image(found[0]), files.values()), strict=True))
    noise: dict[str, float | None] = dict.fromkeys(files)
    taken = None
    try:
        document = json.loads((folder / "plates.json").read_text(encoding="utf-8"))
        taken = str(document["taken"])
        noise |= {name: value for name, value in document["noise"].items() if name in files}
    except OSError:
        pass  # plates of a recorded capture
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("plates.json", [f"is damaged ({error}); take new clean plates"]) from error
    return Plates(files, first, noise, taken)


def write_plates(folder: Path, images: Mapping[str, tuple[ImageRgb, ...]]) -> Plates:
    """Replaces the plates of ``folder``. The old ones stay until the new ones are complete."""
    fresh, old = folder.with_name(folder.name + ".new"), folder.with_name(folder.name + ".old")
    for leftover in (fresh, old):
        shutil.rmtree(leftover, ignore_errors=True)
    targets = [
        (fresh / name / f"{i:03}.png", plate) for name, plates in images.items() for i, plate in enumerate(plates)
    ]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda target: write_image(*target), targets))
        noise = dict(zip(images, pool.map(noise_of, images.values()), strict=True))
    taken = datetime.now(UTC).isoformat(timespec="seconds")
    document = {"format": FORMAT, "taken": taken, "noise": noise}
    write_atomically(fresh / "plates.json", json.dumps(document, indent=1).encode())
    if folder.exists():
        folder.rename(old)
    fresh.rename(folder)
    for leftover in (old, _refused(folder)):
        shutil.rmtree(leftover, ignore_errors=True)
    files = {name: tuple(folder / name / f"{i:03}.png" for i in range(len(plates))) for name, plates in images.items()}
    return Plates(files, {name: plates[0] for name, plates in images.items()}, noise, taken)


def occupied_plates(folder: Path, fresh: Mapping[str, tuple[ImageRgb, ...]], before: Plates) -> tuple[str, ...]:
    """Cameras in whose fresh plates somebody is who is not on the plates ``before``. The pictures are kept beside
    ``folder``: what is still there the next time, unmoved, belongs to the studio."""
    first, refused = {name: images[0] for name, images in fresh.items()}, _refused(folder)
    found = occupied(first, before.first)
    if found and refused.is_dir() and not occupied(first, read_plates(refused, tuple(first)).first):
        return ()
    if found:
        write_plates(refused, {name: (image,) for name, image in first.items()})
    return found


def _refused(folder: Path) -> Path:
    return folder.with_name(folder.name + ".refused")


def link_plates(plates: Plates, background: Path) -> None:
    """Puts the plates' files into a capture's background/, as links where the file system can."""
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
