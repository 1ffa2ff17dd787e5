"""Lists the photographs of a folder by camera and shot.

Files are named ``PHOTOS/<camera>.<ext>`` or ``PHOTOS/<camera>/<shot>.<ext>``, and may lie in ``PHOTOS/images/``.
Pictures with the same shot name were taken at the same moment. A camera's name must be valid as a file name in a
capture.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from rig.errors import InputError
from rig.formats.cameras.cameras_json import CAMERAS_LEAST, name_fault
from rig.formats.captures.capture_folder import capture_root, size_fault
from rig.formats.captures.capture_masks import mask_subjects
from rig.formats.captures.shot_files import ASIDE, find_files, listed_pictures, picture_folder
from rig.formats.pictures.images import decode_image_file
from rig.formats.pictures.picture_names import entry, safe_name
from rig.messages.message import Message, compose, say_once
from rig.rig import Rig

ONE_SHOT = "shot"  # the name of the only one, where every camera has one picture


@dataclass(frozen=True, slots=True, eq=False)
class Photographs:
    """Holds the files of photographs by camera and shot, sorted by name."""

    files: Mapping[str, Mapping[str, Path]]

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the names of the cameras."""
        return tuple(self.files)

    @property
    def shots(self) -> tuple[str, ...]:
        """Returns the names of all shots, sorted."""
        return tuple(sorted({shot for files in self.files.values() for shot in files}))


def find_photographs(folder: Path) -> Photographs:
    """Lists the photographs in ``folder`` by camera and shot. Raises an InputError that names every fault."""
    root = picture_folder(capture_root(folder))
    flat = listed_pictures(root)
    beside = [path for path in sorted(root.iterdir()) if path.is_dir() and path.name.lower() not in ASIDE]
    folders = {safe_name(path.name): listed_pictures(path) for path in beside}
    folders = {name: files for name, files in folders.items() if files}
    if flat and folders:
        is_result = (root / "report.json").is_file()
        raise InputError(folder.name, [compose("is-a-result" if is_result else "photographs-beside-folders")])
    files = folders or {safe_name(path.stem): [path] for path in flat}
    faults = [compose("camera-rename", fault=fault) for name in files if (fault := name_fault(name))]
    if len(files) < CAMERAS_LEAST:
        faults.append(compose("photographs-too-few", count=len(files), needed=CAMERAS_LEAST))
    for name, paths in [*folders.items()] or [(compose("the-folder"), flat)]:
        stems = [safe_name(path.stem) for path in paths]
        twice = sorted({stem for stem in stems if stems.count(stem) > 1})
        faults += [compose("photograph-repeated", folder=name, name=stem, count=stems.count(stem)) for stem in twice]
    if faults:
        raise InputError(folder.name, say_once(faults, files))
    if folders:
        return Photographs({name: {path.stem: path for path in paths} for name, paths in folders.items()})
    return Photographs({name: {ONE_SHOT: path} for name, (path,) in files.items()})


def find_masks(folder: Path, photographs: Photographs, rig: Rig) -> dict[str, Bool[np.ndarray, "_ _"]]:
    """Reads the masks (True = subject) of a single shot from the folder masks/, by camera. Raises InputError if a mask
    is damaged or differs from its photograph in size."""
    root = capture_root(folder)
    if photographs.shots != (ONE_SHOT,) or not entry(root, "masks").is_dir():
        return {}
    planes, faults = {}, list[Message]()
    for name, path in find_files(root, rig, [name for name in photographs.names if name not in rig]).masks.items():
        pixels, _, fault = decode_image_file(path, f"masks/{path.name}", "mask")
        k = rig[name].intrinsics
        if pixels is None:
            assert fault is not None
            faults.append(fault)
        elif pixels.shape != (k.height, k.width):
            faults.append(size_fault(f"masks/{path.name}", (pixels.shape[1], pixels.shape[0]), k))
        else:
            planes[name] = f"masks/{path.name}", pixels
    masks = mask_subjects(planes, rig, faults).masks
    if faults:
        raise InputError(folder.name, faults)
    return dict(masks)
