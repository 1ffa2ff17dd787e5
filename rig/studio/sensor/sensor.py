"""Converts linear light to an 8-bit photograph with lens blur, vignetting, gains, shot noise and the sRGB curve. The
module also draws smooth random fields."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.colour_space import srgb_from_linear
from rig.studio.sensor.preset import Preset

CURVE_STEPS = 1 << 12
MID_GREY = 0.214  # linear light that sRGB writes as 50 %
READ_SHARE = 0.1  # of mid grey's noise variance: what is there without light


@dataclass(frozen=True, slots=True)
class Sensor:
    """Holds the gains (exposure times white balance, by channel) and imperfections of one camera, which do not change
    between pictures."""

    gains: tuple[float, float, float]
    preset: Preset


def _curve() -> UInt8[np.ndarray, " n"]:
    # Steps even in the square root of light: within a third of a grey level over the whole scale.
    light = (np.arange(CURVE_STEPS) / (CURVE_STEPS - 1)) ** 2
    return np.rint(255 * srgb_from_linear(light)).astype(np.uint8)


_CURVE = _curve()


def focus(linear: Float[np.ndarray, "h w 3"], sensor: Sensor) -> Float[np.ndarray, "h w 3"]:
    """Returns the light on the sensor (linear, float32), with lens blur, vignetting and the camera's gains."""
    light = cv2.GaussianBlur(linear, (0, 0), sensor.preset.defocus_px) if sensor.preset.defocus_px > 0 else linear
    height, width = light.shape[:2]
    y, x = np.ogrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    fall_off = (1.0 - sensor.preset.vignetting * (x**2 + y**2) / 2.0).astype(np.float32)
    return light * fall_off[:, :, None] * np.array(sensor.gains, np.float32)


def roll_shutter(subject: Float[np.ndarray, "h w 4"], shift_px: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "h w 4"]:
    """Returns the subject's image by a rolling shutter while the subject moves. ``shift_px`` is the motion between the
    readouts of the first and the last row. The picture's middle row shows the true position."""
    height, width = subject.shape[:2]
    across, down = shift_px / (height - 1)
    source = np.array([[1.0, -across, shift_px[0] / 2], [0.0, 1.0 - down, shift_px[1] / 2]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(subject, source, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)


def expose(light: Float[np.ndarray, "h w 3"], sensor: Sensor, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Converts linear light on the sensor to a picture (sRGB, 0 to 255) with random noise."""
    if sensor.preset.noise > 0:
        # The curve's slope at mid grey is 1.07, so that the noise there is ``noise`` of full scale in the picture.
        variance = (sensor.preset.noise / 1.07) ** 2 * (READ_SHARE + (1 - READ_SHARE) / MID_GREY * np.maximum(light, 0))
        light = light + np.sqrt(variance) * rng.standard_normal(light.shape, np.float32)
    if sensor.preset.read_noise > 0:
        light = light + np.float32(sensor.preset.read_noise) * rng.standard_normal(light.shape, np.float32)
    if sensor.preset.mosaic:
        light = through_mosaic(light)
    step = np.sqrt(np.clip(light, 0.0, 1.0)) * np.float32(CURVE_STEPS - 1) + np.float32(0.5)
    picture = _CURVE[step.astype(np.uint16)]
    return picture if sensor.preset.jpeg_quality is None else compress_jpeg(picture, sensor.preset.jpeg_quality)


def through_mosaic(light: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Simulates a Bayer sensor with red at the first pixel. A pixel measures one channel; OpenCV interpolates the other
    channels along edges. Returns float32."""
    codes = np.rint(65535.0 * np.clip(light, 0.0, 1.0)).astype(np.uint16)
    bayer = codes[:, :, 1].copy()
    bayer[::2, ::2], bayer[1::2, 1::2] = codes[::2, ::2, 0], codes[1::2, 1::2, 2]
    filled = cv2.demosaicing(bayer, cv2.COLOR_BayerRGGB2RGB_EA)
    return filled.astype(np.float32) / np.float32(65535.0)


def compress_jpeg(picture: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, "h w 3"]:
    """Compresses a picture as JPEG with colour at half resolution, and decodes it again."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    data = cv2.imencode(".jpg", np.ascontiguousarray(picture[:, :, ::-1]), flags)[1]
    back = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert back is not None, "OpenCV reads what it wrote"
    return np.ascontiguousarray(back[:, :, ::-1])


def drift(shape: tuple[int, int], amount: float, rng: np.random.Generator) -> Float[np.ndarray, "h w 1"]:
    """Draws a random change of the light between clean plate and shot, as a gain for each pixel. The change is a common
    factor and a slope over the picture, both with a standard deviation of about ``amount``."""
    level, across, down = amount * rng.standard_normal(3)
    y, x = np.ogrid[-1.0 : 1.0 : shape[0] * 1j, -1.0 : 1.0 : shape[1] * 1j]
    return (1.0 + level + 0.5 * (across * x + down * y)).astype(np.float32)[:, :, None]


def volume(rng: np.random.Generator, cells: int) -> UInt8[np.ndarray, "n n n 4"]:
    """Draws independent random bytes for a repeating 3D texture with ``cells`` cells along each side."""
    return rng.integers(0, 256, (cells, cells, cells, 4), np.uint8)


def smooth(
    rng: np.random.Generator, height: int, width: int, cells_high: int, cells_wide: int, channels: int = 1
) -> Float[np.ndarray, "h w c"]:
    """Draws a smooth random field (float32) by cubic interpolation of normally distributed values on a coarse grid."""
    grid = rng.standard_normal((cells_high + 3, cells_wide + 3, channels)).astype(np.float32)
    large = cv2.resize(grid, (width * (cells_wide + 3) // cells_wide, height * (cells_high + 3) // cells_high),
                       interpolation=cv2.INTER_CUBIC)  # fmt: skip
    large = large.reshape(large.shape[0], large.shape[1], channels)
    top, left = (large.shape[0] - height) // 2, (large.shape[1] - width) // 2
    return large[top : top + height, left : left + width]


def around(
    rng: np.random.Generator, rows: int, columns: int, cells_high: int, cells_wide: int
) -> Float[np.ndarray, "h w"]:
    """Draws a smooth random field (float64) with one channel that is periodic from the last to the first column."""
    grid = rng.standard_normal((cells_high + 2, cells_wide)).astype(np.float32)
    grid = np.concatenate([grid[:, -3:], grid, grid[:, :3]], axis=1)
    step = columns / cells_wide
    x = (np.arange(columns, dtype=np.float32) / step + 3.0)[None, :].repeat(rows, 0)
    y = np.linspace(0.5, cells_high + 0.5, rows, dtype=np.float32)[:, None].repeat(columns, 1)
    return cv2.remap(grid, x, y, cv2.INTER_CUBIC).astype(float)


def waves(
    rng: np.random.Generator, points: Float[np.ndarray, "n 3"], shortest_mm: float, longest_mm: float
) -> Float[np.ndarray, " n"]:
    """Draws a random field in space with standard deviation 1, and returns its values at ``points`` (mm). The random
    field is a sum of waves in random directions, with wavelengths from ``shortest_mm`` to ``longest_mm``."""
    count = 32
    directions = rng.normal(0, 1, (count, 3))
    lengths = rng.uniform(shortest_mm, longest_mm, (count, 1))
    directions *= 2 * np.pi / lengths / np.linalg.norm(directions, axis=1, keepdims=True)
    phases = points @ directions.T + rng.uniform(0, 2 * np.pi, count)
    return np.sin(phases).sum(axis=1) / np.sqrt(count / 2)
