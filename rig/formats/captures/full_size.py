"""Reads the pictures of a capture once more, one at a time, at the size of their files.

Everything else works on reduced pictures (``rig.formats.pictures.work_size``). Pores need all pixels, and all pictures
at once would not fit into memory.
"""

from collections.abc import Sequence
from pathlib import Path

from rig.capture import ReadImage
from rig.errors import InputError
from rig.formats.captures.capture_folder import decode_picture
from rig.formats.captures.shot_files import find_files
from rig.formats.pictures.picture_samples import WHOLE_BITS, measure_samples
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig


def full_size_reader(folder: Path, rig: Rig, left_out: Sequence[str] = ()) -> ReadImage:
    """Returns a function that reads the picture of a camera of ``rig`` from a capture's own folder, undistorted as
    ``read_capture`` does it. ``left_out`` are cameras of its file that are not in the rig."""
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
