"""Estimates the skin's relief and its fine colours from two disjoint sets of full-size pictures.

A relief h changes the logarithm of the diffuse shading by ``-g . grad h``. The vector g is the tangential gradient of
the shading by the normal, divided by the shading (Pentland, *Linear shape from shading*, IJCV 1990). In a patch of
skin, a few millimetres wide, shading multiplies each Fourier component of the relief by a constant factor, so the
shading can be inverted to the relief. Waves of the relief at right angles to g do not change the shading, so their
height is estimated near zero.

Pictures have noise and highlights, and the geometry and the cameras are off by a pixel. Therefore the views are split
into two disjoint sets, and the image shift between the sets is removed. For each patch and octave of wavelength, a
Wiener filter keeps the fraction of the power that both sets share. The Wiener filter does not separate colour from
relief; ``COLOUR`` is the fraction of the colour's variation that counts as shading.

The same filter extracts detail for the texture from the difference between pictures of full and of working size.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.fft
from jaxtyping import Bool, Complex, Float, Float16, Float32, Int, UInt8

from pipeline.compute.threads import map_in_threads, map_strips
from pipeline.texturing.layout.uv_unwrap import Layout, draw_over_layout
from pipeline.texturing.light import BAND_FACTORS, harmonics
from pipeline.texturing.paint_kernels import Choice, Pictures, paint_rows
from pipeline.texturing.visibility import LINEAR
from rig.mesh import Mesh

COARSE = 1024  # side of the images: metric and light are smooth
STEP = 1e-3  # of a normal, for the slope of the light
EMPTY = 128  # code of texels beside the layout


@dataclass(frozen=True, slots=True, eq=False)
class TexelFrames:
    """Holds small images, ``COARSE`` texels wide, of quantities that vary slowly over the texture.

    Attributes:
        metric: uu, uv and vv of the squared length (mm2) of a step by one whole image along u and v.
        slope: by how much the logarithm of the light grows with the height's slope: its factors of dh/du and dh/dv,
            where u and v are 1 over the image (1/mm, contravariant).
        skin: share of the relief that is wanted, 0 to 1.
    """

    metric: Float32[np.ndarray, "s s 3"]
    slope: Float32[np.ndarray, "s s 2"]
    skin: Float32[np.ndarray, "s s"]

    def image_mm(self) -> float:
        """Returns the width (mm) of the whole image at the median scale of the skin."""
        metric = self.metric[self.skin > min(0.5, float(self.skin.max()))]
        area2 = metric[:, 0] * metric[:, 2] - metric[:, 1] ** 2
        return float(np.median(np.maximum(area2, 0.0)) ** 0.25) if len(area2) else 1.0

    def at(self, image: Float32[np.ndarray, "s s *c"], x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Interpolates an image at points (x, y) of the unit square."""
        column, row = ((COARSE * at - 0.5).astype(np.float32) for at in (x, y))
        return cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def compute_frames(
    layout: Layout,
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    light: Float[np.ndarray, "9"],
    shading: Float[np.ndarray, " v"],
    skin: Float[np.ndarray, " v"],
) -> TexelFrames:
    """Computes metric, light slopes and skin share of a head as small images over its UV layout.

    ``layout``: the layout of its vertices. ``mesh_world``: the head (mm). ``normals``: unit normals of the vertices.
    ``light``: coefficients of the light (``pipeline.texturing.light``). ``shading``: brightness of the vertices in that
    light, shadows included. ``skin``: factor of the relief at each vertex, 0 to 1.
    """
    along_u, along_v = _steps(layout, mesh_world)
    pull = light_slopes(normals, light) / np.maximum(shading, 1e-3)[:, None]
    pull = pull[layout.source]
    uu, uv, vv = ((a * b).sum(axis=1) for a, b in ((along_u, along_u), (along_u, along_v), (along_v, along_v)))
    on_u, on_v = ((pull * step).sum(axis=1) for step in (along_u, along_v))
    area2 = np.maximum(uu * vv - uv**2, 1e-9)
    slope = np.stack([vv * on_u - uv * on_v, uu * on_v - uv * on_u], axis=1) / area2[:, None]
    values = np.concatenate([np.stack([uu, uv, vv], axis=1), slope, skin[layout.source, None]], axis=1)
    image = draw_over_layout(layout, values, COARSE)
    return TexelFrames(image[:, :, :3].copy(), image[:, :, 3:5].copy(), image[:, :, 5].copy())


def light_slopes(normals: Float[np.ndarray, "v 3"], light: Float[np.ndarray, "9"]) -> Float[np.ndarray, "v 3"]:
    """Returns the gradient of the shading by the normal, projected into the tangent plane."""
    by_axis = []
    for axis in np.eye(3):
        either = [harmonics(_unit(normals + sign * STEP * axis)) * BAND_FACTORS @ light for sign in (1.0, -1.0)]
        by_axis.append((either[0] - either[1]) / (2 * STEP))
    return np.stack(by_axis, axis=1)


def _unit(vectors: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _steps(layout: Layout, mesh: Mesh) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns the derivatives of the surface point (mm) by u and by v at each vertex, as means over its triangles."""
    corners, flat = mesh.vertices[layout.source][layout.faces], layout.uv[layout.faces]
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (s, t), (p, q) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    area = s * q - t * p
    area = np.where(np.abs(area) > 1e-12, area, 1e-12)[:, None]
    along = ((edge * q[:, None] - other * t[:, None]) / area, (other * s[:, None] - edge * p[:, None]) / area)
    count = np.maximum(np.bincount(layout.faces.ravel(), minlength=len(layout.uv)), 1)[:, None]
    along_u, along_v = (_sums(layout.faces, step, len(layout.uv)) / count for step in along)
    return along_u, along_v


def _sums(faces: Int[np.ndarray, "f 3"], values: Float[np.ndarray, "f 3"], count: int) -> Float[np.ndarray, "n 3"]:
    columns = [np.bincount(faces.ravel(), np.repeat(values[:, axis], 3), count) for axis in range(3)]
    return np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Holds a UV layout's triangles in an image ``size`` texels wide and high, sorted by image rows."""

    layout: Layout
    size: int
    texels: Float[np.ndarray, "n 2"]
    low: Float[np.ndarray, " f"]
    high: Float[np.ndarray, " f"]

    @classmethod
    def of(cls, layout: Layout, size: int, wanted: Bool[np.ndarray, " v"] | None = None) -> "Strips":
        """Places the triangles of a UV layout in the image: all of them, or only those with a ``wanted`` vertex."""
        texels = size * layout.uv - 0.5
        rows = texels[layout.faces, 1]
        low, high = rows.min(axis=1), rows.max(axis=1)
        if wanted is not None:
            high[~wanted[layout.source][layout.faces].any(axis=1)] = -np.inf
        return cls(layout, size, texels, low, high)

    def paint(self, first: int, rows: int, pictures: Pictures, choice: Choice) -> UInt8[np.ndarray, "r s 3"]:
        """Paints ``rows`` image rows (BGR codes), starting at row ``first``, which may be negative."""
        strip = np.full((rows, self.size, 3), EMPTY, np.uint8)
        which = np.flatnonzero((self.high >= first) & (self.low <= first + rows - 1))
        moved = self.texels - (0.0, float(first))
        paint_rows(strip, 0, rows, which, moved, self.layout.faces, self.layout.source, pictures, choice)
        return strip


SHORTEST_MM, LONGEST_MM = 0.3, 3.5  # of the waves that are kept; 0.1 mm a pixel resolve 0.3 mm
PATCH_MM = 8.0  # two of the longest waves
COLOUR = 0.1  # contrast of skin's own colour by that of a slope of 1 in light of full contrast
OCTAVES = 4
LUMINANCE = np.array([0.0722, 0.7152, 0.2126], np.float32)  # blue first
MIN_LIGHT = 0.004  # linear; darker pixels are noise
MAX_CONTRAST = 0.2  # rms of the shading in a patch beyond which it is lashes, brows or lips
MAX_SHIFT_MM = 0.4  # between the two sets, for errors of the geometry and of the cameras
MIN_SKIN = 0.05
STRIP_ROWS = 128
BLURRED_SIDE = 32  # texels of a patch's side for a Gaussian of a sixth of it

Spectra = Complex[np.ndarray, "n p q"]


@dataclass(frozen=True, slots=True, eq=False)
class SkinDetail:
    """Holds the skin's relief and fine brightness from full-size pictures, as images with the texture's UV layout.

    Attributes:
        heights_mm: the relief, along the normals.
        brightness: logarithm of the light that the pictures of work size do not show.
        repeated: share of the shading's power that both sets of views show, by octave from the longest wave.
    """

    heights_mm: Float32[np.ndarray, "s s"]
    brightness: Float16[np.ndarray, "s s"]
    repeated: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class HalfPictures:
    """Holds two disjoint sets of views with packed pictures, at full size and at working size."""

    full: Pictures
    work: Pictures
    choices: tuple[Choice, Choice]


def estimate_detail(strips: Strips, halves: HalfPictures, frames: TexelFrames) -> SkinDetail:
    """Estimates the skin's relief and fine brightness over a UV layout, one row of patches after the other."""
    size = strips.size  # and the side of a patch, a power of two, for skin at the layout's usual scale
    side = int(np.clip(2 ** round(np.log2(PATCH_MM * size / frames.image_mm())), 16, 256))
    hop, figures = side // 2, np.zeros((OCTAVES, 2))
    light = _painted(strips, halves)
    heights, brightness = np.zeros((size, size), np.float32), np.zeros((size, size), np.float16)
    rows = range(-hop, size, hop)
    for parity in (0, 1):  # rows of patches overlap by half: every second one does not
        chosen = rows[parity::2]
        found = np.zeros((len(chosen), OCTAVES, 2))

        def work(k: int, chosen: range = chosen, found: np.ndarray = found) -> None:
            low, high = max(chosen[k], 0), min(chosen[k] + side, size)
            missing = ((low - chosen[k], chosen[k] + side - high), (hop, hop))
            cut = [[np.pad(image[low:high].astype(np.float32), missing) for image in pair] for pair in light]
            parts = _row_of_patches(cut[0], cut[1], chosen[k], size, frames, found[k])
            if parts is not None:
                inside = slice(low - chosen[k], high - chosen[k])
                heights[low:high] += parts[0][inside]
                brightness[low:high] += parts[1][inside].astype(np.float16)

        map_in_threads(work, len(chosen))
        figures += found.sum(axis=0)
    return SkinDetail(heights, brightness, tuple((figures[:, 0] / np.maximum(figures[:, 1], 1e-12)).tolist()))


def _painted(strips: Strips, halves: HalfPictures) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns the logarithm of the full-size pictures' light in both sets of views, and its difference from the
    pictures of working size. The arrays are float16, whose rounding is below the pictures' noise."""
    size = strips.size
    full, added = (list(np.zeros((2, size, size), np.float16)) for _ in range(2))

    def work(rows: slice) -> None:
        for half, choice in enumerate(halves.choices):
            fine, coarse = (
                log_light(strips.paint(rows.start, rows.stop - rows.start, pictures, choice))
                for pictures in (halves.full, halves.work)
            )
            full[half][rows], added[half][rows] = fine, fine - coarse

    map_strips(work, size, STRIP_ROWS)
    return full, added


def log_light(codes: np.ndarray) -> Float32[np.ndarray, "r s"]:
    """Returns the logarithm of the light in a painted strip, relative to middle grey."""
    return np.log(np.maximum(LINEAR[codes] @ LUMINANCE, MIN_LIGHT) / LINEAR[EMPTY])


def remove_slow(light: Float32[np.ndarray, "r s"], side: int) -> Float32[np.ndarray, "r s"]:
    """Subtracts structures wider than a third of a patch, which would leak into all Fourier components.

    The wide Gaussian is computed on a downsampled strip, which takes a fiftieth of the time for a texture of 8192
    texels. On pure noise the downsampling changes the result by at most 0.3 % of the noise's spread."""
    height, width = light.shape
    step = max(side // BLURRED_SIDE, 1)
    coarse = cv2.resize(light, (width // step, height // step), interpolation=cv2.INTER_AREA)
    slow = cv2.GaussianBlur(coarse, (0, 0), side / (6.0 * step), borderType=cv2.BORDER_REFLECT)
    return light - cv2.resize(slow, (width, height), interpolation=cv2.INTER_LINEAR)


def _row_of_patches(
    full: list[np.ndarray],
    added: list[np.ndarray],
    row: int,
    size: int,
    frames: TexelFrames,
    figures: Float[np.ndarray, "o 2"],
) -> tuple[Float32[np.ndarray, "r s"], Float32[np.ndarray, "r s"]] | None:
    """Returns heights and brightness of one row of patches, windowed so that overlapping rows can be added; None
    without skin. Adds the power spectra to ``figures``."""
    side = len(full[0])
    hop = side // 2
    columns = np.arange(-hop, size, hop)
    x = np.clip((columns + hop) / size, 0.0, 1.0)[None]
    y = np.full(x.shape, np.clip((row + hop) / size, 0.0, 1.0))
    skin = frames.at(frames.skin, x, y)[0]
    which = np.flatnonzero(skin >= MIN_SKIN)
    if not len(which):
        return None
    metric, slope = (frames.at(image, x, y)[0][which] for image in (frames.metric, frames.slope))
    patches = Patches.of(side, metric / size**2, slope * size)
    window = np.sin(np.pi * (np.arange(side, dtype=np.float32) + 0.5) / side)
    window = window[:, None] * window[None, :]
    cuts = [slice(columns[k] + hop, columns[k] + hop + side) for k in which]

    def windowed(strip: np.ndarray) -> Float32[np.ndarray, "n q q"]:
        band = remove_slow(strip, side)
        return np.stack([band[:, cut] for cut in cuts]) * window

    shades = [windowed(strip) for strip in full]
    first, second = (np.asarray(scipy.fft.rfft2(shade)) for shade in shades)  # in a quarter of NumPy's time
    turn = patches.shift_between(first, second)
    relief, powers = patches.relief(first * turn, second * np.conj(turn))
    figures += powers
    contrast2 = np.mean((shades[0] + shades[1]) ** 2, axis=(1, 2))  # the window leaves a quarter of the power
    share = np.minimum(skin[which], 1.0)
    muted = share / (1.0 + (contrast2 / MAX_CONTRAST**2) ** 2)
    pair = [np.asarray(scipy.fft.rfft2(windowed(strip))) for strip in added]
    finer = patches.common(pair[0] * turn, pair[1] * np.conj(turn))
    out = np.zeros((2, side, size + side), np.float32)
    for image, waves, weight in zip(out, (relief, finer), (muted, share), strict=True):
        drawn = fields_of(waves, side) * window * weight[:, None, None].astype(np.float32)
        for cut, patch in zip(cuts, drawn, strict=True):
            image[:, cut] += patch
    return out[0, :, hop : hop + size], out[1, :, hop : hop + size]


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Holds the Fourier components of square patches of one size. Each component has a frequency (cycles per mm), the
    shading that 1 mm of height causes, and an octave (-1: discarded)."""

    side: int
    per_mm: Float32[np.ndarray, "n p q"]
    shading: Spectra
    octave: Int[np.ndarray, "n p q"]

    @classmethod
    def of(cls, side: int, metric: Float[np.ndarray, "n 3"], slope: Float[np.ndarray, "n 2"]) -> "Patches":
        """Computes the Fourier components of patches.

        Args:
            side: texels.
            metric: uu, uv, vv of a step by one texel, mm2.
            slope: the light's factors of dh/du and dh/dv for steps of one texel.
        """
        fu, fv = waves_by_texel(side)
        uu, uv, vv = (metric[:, i, None, None].astype(np.float32) for i in range(3))
        area2 = np.maximum(uu * vv - uv**2, 1e-12)
        per_mm = np.sqrt(np.maximum(vv * fu**2 - 2 * uv * fu * fv + uu * fv**2, 0.0) / area2)
        along, down = (slope[:, i, None, None].astype(np.float32) for i in range(2))
        shading = np.complex64(-2j * np.pi) * (along * fu + down * fv)
        octave = np.floor(np.log2(np.maximum(per_mm, 1e-9) * LONGEST_MM)).astype(np.int8)
        octave[(octave < 0) | (per_mm > 1 / SHORTEST_MM) | (octave >= OCTAVES)] = -1
        return cls(side, per_mm, shading, octave)

    def shift_between(self, first: Spectra, second: Spectra) -> Spectra:
        """Returns the phase factor of each wave that shifts the first set half-way to the second. The factor's
        conjugate shifts the second set half-way to the first. Only shifts up to ``MAX_SHIFT_MM`` are searched."""
        cross = np.where(self.octave >= 0, np.conj(first) * second, np.complex64(0.0))
        peaks = np.fft.fftshift(fields_of(cross, self.side), axes=(1, 2))
        fu, fv = waves_by_texel(self.side)
        middle, shifts = self.side // 2, np.zeros((len(first), 2), np.float32)
        for k, peak in enumerate(peaks):
            texels = self.side * max(float(self.per_mm[k, 0, 1]), float(self.per_mm[k, 1, 0]))  # a mm
            reach = int(np.clip(np.ceil(MAX_SHIFT_MM * texels) + 1, 2, self.side // 4))
            box = peak[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
            row, column = divmod(int(box.argmax()), box.shape[1])
            if 0 < row < 2 * reach and 0 < column < 2 * reach:
                shifts[k, 0] = column - reach + _vertex(box[row, column - 1 : column + 2])
                shifts[k, 1] = row - reach + _vertex(box[row - 1 : row + 2, column])
        return np.exp(np.complex64(-1j * np.pi) * (fu * shifts[:, :1, None] + fv * shifts[:, 1:, None]))

    def repeating(self, first: Spectra, second: Spectra) -> tuple[Float32[np.ndarray, "n p q"], np.ndarray]:
        """Returns the Wiener weight of each wave in the mean of two sets of views. The function also returns, for each
        octave, the power that both sets share and the total power."""
        common = np.real(first * np.conj(second))
        either = np.abs(first) ** 2 + np.abs(second) ** 2
        weight, powers = np.zeros(self.per_mm.shape, np.float32), np.zeros((OCTAVES, 2))
        for octave in range(OCTAVES):
            inside = self.octave == octave
            repeats = np.maximum(np.sum(common, axis=(1, 2), where=inside), 0.0)
            power = 0.5 * np.sum(either, axis=(1, 2), where=inside)
            powers[octave] = repeats.sum(), power.sum()
            share = np.minimum(2 * repeats / np.maximum(power + repeats, 1e-12), 1.0)  # of the mean's power
            weight += np.where(inside, share[:, None, None], 0.0)
        return weight, powers

    def common(self, first: Spectra, second: Spectra) -> Spectra:
        """Returns the Fourier components that two sets of views share."""
        return 0.5 * self.repeating(first, second)[0] * (first + second)

    def relief(self, first: Spectra, second: Spectra) -> tuple[Spectra, Float[np.ndarray, "o 2"]]:
        """Returns the Fourier components of the relief, given those of the shading in two sets of views. The function
        also returns the powers from ``repeating``."""
        weight, powers = self.repeating(first, second)
        noise2 = np.maximum((2 * np.pi * COLOUR * self.per_mm) ** 2, 1e-12)
        gain = weight * np.conj(self.shading) / (np.abs(self.shading) ** 2 + noise2)
        return 0.5 * gain * (first + second), powers


def fields_of(waves: Complex[np.ndarray, "n s h"], side: int) -> Float32[np.ndarray, "n s s"]:
    """Returns the inverse Fourier transforms of patches ``side`` texels wide and high."""
    return np.asarray(scipy.fft.irfft2(waves, (side, side)))


def waves_by_texel(side: int) -> tuple[Float32[np.ndarray, "p q"], Float32[np.ndarray, "p q"]]:
    """Returns the frequencies (cycles per texel, across and down) of the Fourier components of a square patch."""
    down, across = np.meshgrid(np.fft.fftfreq(side), np.fft.rfftfreq(side), indexing="ij")
    return across.astype(np.float32), down.astype(np.float32)


def _vertex(three: Float32[np.ndarray, " 3"]) -> float:
    """Returns the offset of a peak from the middle one of three neighbouring values, by a parabola."""
    bend = float(three[0] - 2 * three[1] + three[2])
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (three[0] - three[2]) / bend, -0.5, 0.5))
