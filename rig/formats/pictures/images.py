"""Reads picture files, whose content determines the format, and writes picture files atomically.

OpenCV decodes ordinary pictures (8 or 16 bits), LibRaw decodes RAW and DNG, and libheif decodes HEIC. Photographs are
converted to 8-bit sRGB. A Netpbm picture's header states the value of white (4095 for 12 bits), which becomes 255.
EXIF's orientation is ignored, because calibrations refer to the sensor's rows and columns."""

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from rig.errors import InputError, how_to_install
from rig.files import write_atomically
from rig.formats.pictures.mask_values import Plane, mask_plane, subject_convention
from rig.formats.pictures.picture_names import HEIC_SUFFIXES, IMAGE_SUFFIXES, RAW_SUFFIXES
from rig.formats.pictures.picture_samples import TIFF, WHOLE_BITS
from rig.formats.pictures.work_size import at_share, halvings
from rig.image import ImageRgb
from rig.messages.message import Message, compose

# Pillow's names. JPEG covers the MPO that many phones write into a .jpg, PPM all of Netpbm's maps.
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM")
PictureKind = Literal["colour", "grey", "mask"]
JPEG = b"\xff\xd8\xff"
NO_MEMORY = -4  # cv::Error::StsNoMem
START_OF_SCAN = 0xDA
WITHOUT_LENGTH = frozenset((0x00, 0x01, 0xC8, *range(0xD0, 0xDA), *range(0xF0, 0xFE)))  # segments of a marker alone
SEGMENTS_MOST, METADATA_BYTES = 1000, 16 << 20  # in front of a JPEG's pixels; depth maps of telephones have 5 MB
EXIF_MOST = 16  # segments of EXIF; the standard knows one
NETPBM = re.compile(
    rb"P[2356](?:\s|#[^\n]*\n)+\d+(?:\s|#[^\n]*\n)+\d+(?:\s|#[^\n]*\n)+(\d+)\s"
)  # its last number is the value of white
PNG_COLOUR_TYPE, PNG_WITH_ALPHA = 25, (4, 6)  # offset of the header's colour type, and its values with alpha
CUT_AWAY_LEAST = 0.25  # transparent share of a cut-out picture; the empty rim of an undistorted one is 0.1 at most
PNG, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
FTYP = slice(4, 12)  # bytes that name the kind of a HEIC, AVIF or video file
HEIC_BRANDS = (b"ftypheic", b"ftypheix", b"ftypmif1")  # in telephones' .jpg files, too
OTHER_BRANDS = {b"ftypavif": "AVIF", b"ftypisom": "video", b"ftypmp42": "video", b"ftypqt  ": "video"}
OTHER_BEGINNINGS = {b"GIF8": "GIF", b"%PDF": "PDF", b"8BPS": "Photoshop", b"\xff\x0a": "JPEG XL"}
GREY_FLAGS = (
    cv2.IMREAD_GRAYSCALE,
    cv2.IMREAD_REDUCED_GRAYSCALE_2,
    cv2.IMREAD_REDUCED_GRAYSCALE_4,
    cv2.IMREAD_REDUCED_GRAYSCALE_8,
)
COLOUR_FLAGS = (  # the reducing ones give BGR; OpenCV has no RGB variant of them
    cv2.IMREAD_COLOR_RGB,
    cv2.IMREAD_REDUCED_COLOR_2,
    cv2.IMREAD_REDUCED_COLOR_4,
    cv2.IMREAD_REDUCED_COLOR_8,
)
PAGED_SUFFIXES = (".tif", ".tiff", ".webp")  # of files that hold several pictures
PIXELS_MOST = 100_000_000  # 100 Mpx, the largest studio backs; more is a decompression bomb
# Sensor noise does not repeat, so a search for repeats is useless: this halves the time and saves a sixth of space.
PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
)


def is_picture(path: Path) -> bool:
    """Returns whether a path is a visible regular file with a picture's suffix."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file()


def write_image(
    path: Path, image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], quality: int = 95, *, parents: bool = True
) -> None:
    """Writes RGB or grey pixels in the format of the suffix. ``quality`` is JPEG's. ``parents`` creates missing
    folders."""
    options = (cv2.IMWRITE_JPEG_QUALITY, quality) if path.suffix == ".jpg" else PNG_OPTIONS
    write_atomically(path, encode_image(path.suffix, image, options), parents=parents)


def encode_image(suffix: str, image: np.ndarray, options: Sequence[int] = ()) -> bytes:
    """Encodes RGB, RGBA or grey pixels in the format ``suffix``. ``options`` are encoding options of OpenCV."""
    if image.ndim == 3:  # OpenCV's blue comes first
        image = np.concatenate([image[:, :, 2::-1], image[:, :, 3:]], axis=2)
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    assert done
    return data.tobytes()


def read_image(path: Path) -> ImageRgb:
    """Reads a picture file as RGB. Raises InputError for a damaged file or one that is no picture."""
    pixels, _, fault = decode_image_file(path, path.name, "colour")
    if pixels is None:
        assert fault is not None
        raise InputError(path.name, [fault])
    return pixels


def picture_size(path: Path) -> tuple[int, int]:
    """Returns a picture's width and height (px) from the file's header. The picture file is not decoded, because a
    small file may claim a huge size. Raises InputError if the picture file has no valid header."""
    with _faults_of(path.name):
        return _header_size(path.read_bytes(), path.suffix.lower())[0]


def page_count(path: Path) -> int:
    """Returns the number of pictures in a TIFF or WebP file, or 1 for other and damaged files."""
    if path.suffix.lower() not in PAGED_SUFFIXES:
        return 1
    try:
        with _faults_of(path.name), Image.open(path, formats=IMAGE_FORMATS) as header:
            return int(getattr(header, "n_frames", 1))
    except InputError:
        return 1


def open_picture(path: Path) -> Image.Image:
    """Opens a picture with Pillow, which can decode only as much as a thumbnail needs. Raises InputError."""
    if path.suffix.lower() in (*RAW_SUFFIXES, *HEIC_SUFFIXES):
        return Image.fromarray(read_image(path))
    with _faults_of(path.name):
        return Image.open(path, formats=IMAGE_FORMATS)


def decode_image_file(
    path: Path, where: str, kind: PictureKind, *, share: float = 1.0, bits: int = 16
) -> tuple[np.ndarray | None, str, Message | None]:
    """Decodes a picture file, called ``where`` in messages. Returns the picture's pixels and the file's SHA-256, or a
    fault if the file is damaged. For ``kind`` colour the pixels are RGB, for grey one channel, and for mask the mask's
    unchanged channel (``rig.formats.pictures.mask_values``). ``share`` scales width and height, except of masks.
    ``bits`` is the number of used bits in a 16-bit file (``rig.formats.pictures.picture_samples``)."""
    suffix, data = path.suffix.lower(), b""
    try:
        with _faults_of(where):
            data = path.read_bytes()
            (width, height), profile = _header_size(data, suffix)
        if width * height > PIXELS_MOST:
            raise InputError(where, [compose("picture-large", width=width, height=height, most=PIXELS_MOST)])
        with _faults_of(where, compose("picture-damaged")):
            pixels = _decoded(data, suffix, kind, halved=halvings(share, (width, height)), bits=bits)
        pixels = _plane(pixels, where) if kind == "mask" else at_share(pixels, (width, height), share)
    except InputError as error:
        fault = compose("picture-floats") if _holds_floats(data) else error.faults[0]
        return None, "", compose("of-file", file=where, fault=fault)
    if data.startswith(PNG) and PNG_END not in data:  # OpenCV silently fills the missing part of a truncated file
        return None, "", compose("of-file", file=where, fault=compose("picture-damaged"))
    if profile and kind == "colour":
        pixels = _in_srgb(pixels, profile)
    return pixels, hashlib.sha256(data).hexdigest(), None


def cut_out_alpha(path: Path) -> Plane | None:
    """Returns the unchanged alpha channel of a picture in which only the subject is opaque.

    Returns None if the file has no alpha channel, is too large or damaged, or if the opaque part cannot be a subject. A
    subject is in the middle, and at least the fraction ``CUT_AWAY_LEAST`` of the picture around it is transparent.
    Rounded corners and empty rims of undistorted pictures are smaller than ``CUT_AWAY_LEAST``."""
    data, suffix = path.read_bytes(), path.suffix.lower()
    if data.startswith(PNG):
        if len(data) <= PNG_COLOUR_TYPE or data[PNG_COLOUR_TYPE] not in PNG_WITH_ALPHA:
            return None
    elif suffix not in (".webp", ".tif", ".tiff"):
        return None
    try:
        with _faults_of(path.name):
            (width, height), _ = _header_size(data, suffix)
            if width * height > PIXELS_MOST:
                return None
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except InputError:
        return None
    if pixels is None or pixels.ndim != 3 or pixels.shape[2] != 4:
        return None
    alpha = np.ascontiguousarray(pixels[..., 3])
    opaque = alpha > {"uint8": 127, "uint16": 32767}.get(alpha.dtype.name, 0.5)
    if 1.0 - opaque.mean() < CUT_AWAY_LEAST or subject_convention(opaque) != "white":
        return None
    return alpha


@contextmanager
def _faults_of(where: str, fault: Message | None = None) -> Iterator[None]:
    """Converts the exceptions that decoders raise for a damaged file to InputError."""
    said = fault or compose("no-picture")
    try:
        yield
    except PermissionError as error:
        raise InputError(where, [compose("no-file-read", reason=error.strerror or str(error))]) from error
    except Image.DecompressionBombError as error:
        raise InputError(where, [compose("picture-huge", most=PIXELS_MOST)]) from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, cv2.error) as error:
        if isinstance(error, cv2.error) and error.code == NO_MEMORY:
            raise MemoryError from error
        raise InputError(where, [said]) from error


def _header_size(data: bytes, suffix: str) -> tuple[tuple[int, int], bytes]:
    """Returns a picture's width and height (px) and colour profile, which is empty for sRGB."""
    if suffix in RAW_SUFFIXES:
        with _raw(data) as raw:
            return (raw.sizes.width, raw.sizes.height), b""
    if suffix in HEIC_SUFFIXES or data[FTYP] in HEIC_BRANDS:
        header = heif_header(data)
        return header.size, header.info.get("icc_profile") or b""
    if data[FTYP] in OTHER_BRANDS or data.startswith(tuple(OTHER_BEGINNINGS)):
        kind = OTHER_BRANDS.get(data[FTYP]) or next(k for b, k in OTHER_BEGINNINGS.items() if data.startswith(b))
        raise InputError("picture", [compose("picture-of-kind", kind=kind)])
    _check_metadata(data)
    with Image.open(BytesIO(data), formats=IMAGE_FORMATS) as header:  # reads the header only
        return header.size, header.info.get("icc_profile") or b""


def _check_metadata(data: bytes) -> None:
    """Raises InputError for a JPEG with far more metadata than cameras write, because Pillow joins EXIF segments in
    quadratic time."""
    if not data.startswith(JPEG):
        return
    at, segments, exif = 2, 0, 0
    while data[at : at + 1] == b"\xff" and at + 1 < len(data) and data[at + 1] != START_OF_SCAN:
        exif += data[at + 4 : at + 10] == b"Exif\0\0"
        if data[at + 1] == 0xFF:
            at += 1
        elif data[at + 1] in WITHOUT_LENGTH:
            at += 2
        else:
            at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
        segments += 1
        if segments > SEGMENTS_MOST or at > METADATA_BYTES or exif > EXIF_MOST:
            raise InputError("picture", [compose("picture-metadata-large", megabytes=METADATA_BYTES >> 20)])


def _decoded(data: bytes, suffix: str, kind: PictureKind, *, halved: int, bits: int) -> np.ndarray:
    """Returns the decoded pixels. ``halved`` is how many times a JPEG is halved during decoding, which saves time."""
    if suffix in RAW_SUFFIXES:
        with _raw(data) as raw:
            # The camera's white balance, and no automatic brightness: pictures of all cameras must stay comparable.
            pixels = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8, user_flip=0)
    elif suffix in HEIC_SUFFIXES or data[FTYP] in HEIC_BRANDS:
        pixels = np.asarray(heif_header(data).to_pillow().convert("RGB"))
    else:
        white = NETPBM.match(data, 0, 1 << 12)
        if white is not None and int(white[1]) not in (255, 65535):
            return _of_white(data, int(white[1]), kind)
        halved = halved if data.startswith(JPEG) and kind != "mask" else 0
        flags = cv2.IMREAD_UNCHANGED if kind == "mask" else (GREY_FLAGS if kind == "grey" else COLOUR_FLAGS)[halved]
        flags |= cv2.IMREAD_ANYDEPTH if bits < WHOLE_BITS and kind != "mask" else 0
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            raise ValueError("not decoded")
        if kind == "mask":
            return pixels
        if pixels.dtype == np.uint16:
            pixels = np.minimum(np.right_shift(pixels, bits - 8), 255).astype(np.uint8)
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if halved and kind == "colour" else pixels
    if kind == "mask":
        return pixels
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if kind == "grey" else np.ascontiguousarray(pixels)


def _holds_floats(data: bytes) -> bool:
    """Returns whether a TIFF file contains floating-point values, as HDR programs write."""
    if not data.startswith(TIFF):
        return False
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels is not None and pixels.dtype.kind == "f"


def _of_white(data: bytes, white: int, kind: PictureKind) -> np.ndarray:
    """Decodes a Netpbm file whose value of white is neither 255 nor 65535. Raises ValueError."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or not 0 < white < 65536:
        raise ValueError("not decoded")
    if kind == "mask":
        return pixels
    bytes_of = np.clip(np.round(np.arange(65536) * (255.0 / white)), 0, 255).astype(np.uint8)
    pixels = bytes_of[np.asarray(pixels, np.uint16)]
    if kind == "grey":
        return pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB if pixels.ndim == 2 else cv2.COLOR_BGR2RGB)


def _plane(pixels: np.ndarray, where: str) -> Plane:
    plane = mask_plane(pixels)
    if isinstance(plane, Message):
        raise InputError(where, [plane])
    return plane


@contextmanager
def _raw(data: bytes) -> Iterator[Any]:
    import rawpy  # 0.1 s, and a library that few captures need

    try:
        with rawpy.imread(BytesIO(data)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        raise ValueError(str(error)) from error


def heif_header(data: bytes) -> Any:
    """Opens a HEIC file without decoding it. Raises InputError if libheif is not installed."""
    try:
        import pi_heif
    except ModuleNotFoundError:
        raise InputError("picture", [compose("heic-not-installed", remedy=how_to_install("heic"))]) from None
    return pi_heif.open_heif(BytesIO(data))


def _in_srgb(pixels: ImageRgb, profile: bytes) -> ImageRgb:
    """Converts colours from ``profile`` (such as Display P3 or Adobe RGB) to sRGB. An unreadable profile counts as
    sRGB."""
    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return pixels
        into = ImageCms.createProfile("sRGB")
        turned = ImageCms.profileToProfile(Image.fromarray(pixels), source, into, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError):
        return pixels
    return pixels if turned is None else np.array(turned)
