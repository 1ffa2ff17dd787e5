"""Draws the pictures of a result: the contours of silhouette and fitted head over each image, the contact sheet, and
the turntable strip. The module also renders a head as grey clay or in colours.

A contour is painted from its signed distance d with opacity ``half width + 1/2 - |d|``, so it is antialiased. Vermilion
and sky blue can be told apart with every kind of colour vision (Okabe and Ito, *Color Universal Design*,
https://jfly.uni-koeln.de/color/); a dark border keeps the lines readable on any image.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.geometry.projection import picture
from pipeline.imaging.masks import box_around, chamfer
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.image import ImageRgb
from rig.mesh import Mesh

SKIN = np.array([214.0, 188.0, 168.0])
LAMP = np.array([-0.35, 0.45, 0.82])  # head frame
AZIMUTH_DEG, CLAY_PANEL = 30.0, (360, 480)
DARKEST = 0.25  # of the colour, where no light comes
INPUT_COLOUR = (70, 215, 255)  # sky blue, a little lighter
FITTED_COLOUR = (255, 110, 20)  # vermilion, a little lighter
PART_COLOURS = {"skin": (240, 228, 66), "hair": (0, 158, 115), "clothes": (204, 121, 167)}  # Okabe and Ito's, too
TINT = 0.3  # of a part's colour where a pixel surely shows it
AZIMUTHS_DEG = (-80, -60, -40, -20, 0, 20, 40, 60, 80)
PANEL = (480, 360)  # width and height of one panel of the contact sheet
PAPER = (245, 245, 245)
KEY_PX = 36  # height of a sheet's line that says what its colours mean
MARGIN_PX = 16  # around a fitted mask: wider than any line that is painted

Box = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]
Resized = UInt8[np.ndarray, "_ _ 3"]  # a picture of any size, whatever others the call has


def overlay(
    image: ImageRgb,
    input_distance: Float32[np.ndarray, "h w"],
    fitted_mask: Bool[np.ndarray, "h w"],
    label: str = "",
    parts: Float32[np.ndarray, "h w 3"] | None = None,
) -> ImageRgb:
    """Draws the contours of the silhouette (sky blue) and of the fitted head (vermilion) on the image.

    Args:
        image: the photograph.
        input_distance: signed distance to the silhouette, px.
        fitted_mask: the pixels that the fitted head covers.
        label: text in a corner.
        parts: probabilities of skin, hair and clothes, by which each pixel is tinted; None means no tint.
    """
    line = max(1.0, 1.5 * image.shape[1] / 1024)
    painted = image.copy() if parts is None else tinted(image, parts)
    contours = [_near(input_distance, line), _near(_smooth_distance(fitted_mask), line)]
    for near in contours:
        _paint(painted, near, (0, 0, 0), line + 1.0, 0.45)
    for near, colour in zip(contours, (INPUT_COLOUR, FITTED_COLOUR), strict=True):
        _paint(painted, near, colour, line, 1.0)
    entries = [(label, (255, 255, 255))] if label else []
    entries += [("input outline", INPUT_COLOUR), ("fitted head", FITTED_COLOUR)]
    return legend(painted, entries + ([] if parts is None else list(PART_COLOURS.items())))


def tinted(image: ImageRgb, parts: Float32[np.ndarray, "h w 3"]) -> ImageRgb:
    """Tints each pixel with the colours of skin, hair and clothes in proportion to their probabilities."""
    colours = TINT * np.array(list(PART_COLOURS.values()), np.float32)
    left = 1.0 - cv2.transform(parts, np.full((1, 3), TINT, np.float32))
    return cv2.convertScaleAbs(image * left[..., None] + cv2.transform(parts, colours.T))  # it rounds


def difference(image: ImageRgb, observed: Bool[np.ndarray, "h w"], model: Bool[np.ndarray, "h w"]) -> Resized:
    """Draws the difference of two masks (the paper's eq. 4) over a pale copy of the image, in a panel's size. Pixels
    only in the input mask are sky blue, pixels only in the model's mask vermilion."""
    size = _fitted_size(image)
    image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    observed, model = (
        cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in (observed, model)
    )
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    shade = np.round(0.35 * np.arange(256) + 150.0)
    pale, dark = shade.astype(np.uint8), (shade - 60.0).astype(np.uint8)
    canvas = cv2.cvtColor(np.where(observed & model, dark[grey], pale[grey]), cv2.COLOR_GRAY2RGB)
    for where, colour in ((observed & ~model, INPUT_COLOUR), (model & ~observed, FITTED_COLOUR)):
        canvas[where] = (0.25 * canvas[where] + 0.75 * np.array(colour, np.float32)).astype(np.uint8)
    return canvas


def legend(image: ImageRgb, entries: Sequence[tuple[str, tuple[int, int, int]]]) -> ImageRgb:
    """Writes lines of text, each in its own colour, on a dark ground in the top left corner of an image."""
    if not entries:
        return image
    scale = max(0.5, image.shape[1] / 1280)
    line, pad = round(28 * scale), round(8 * scale)
    font = cv2.FONT_HERSHEY_SIMPLEX
    width = max(cv2.getTextSize(text, font, scale * 0.8, 1)[0][0] for text, _ in entries) + 2 * pad
    out = image.copy()
    ground = out[: line * len(entries) + pad, :width]
    ground[:] = (ground * 0.3).astype(np.uint8)
    for i, (text, colour) in enumerate(entries):
        cv2.putText(out, text, (pad, (i + 1) * line - pad // 2), font, scale * 0.8, colour, 1, cv2.LINE_AA)
    return out


def turntable(
    mesh_head: Mesh, colours: UInt8[np.ndarray, "v 3"], panel: tuple[int, int] = (280, 360)
) -> list[ImageRgb]:
    """Draws the head from each azimuth in ``AZIMUTHS_DEG``. ``panel`` is width and height of each picture, px."""
    box = mesh_head.vertices.min(axis=0), mesh_head.vertices.max(axis=0)
    return map_in_threads(lambda k: portrait(mesh_head, colours, box, AZIMUTHS_DEG[k], panel), len(AZIMUTHS_DEG))


def portrait(
    mesh: Mesh, colours: UInt8[np.ndarray, "v 3"], box: Box, azimuth_deg: float, panel: tuple[int, int], *,
    paper: tuple[int, int, int] = PAPER, lift: float = 0.0, share: float = 0.9,
) -> ImageRgb:  # fmt: skip
    """Draws a mesh (head frame) from an azimuth about y and an elevation ``lift``, with twofold supersampling. ``box``:
    opposite corners of the part of the mesh that fills ``share`` of the ``panel`` (px)."""
    centre, radius = (box[0] + box[1]) / 2, float(np.linalg.norm(box[1] - box[0])) / 2
    width, height = 2 * panel[0], 2 * panel[1]
    azimuth, distance = np.radians(azimuth_deg), 6.0 * radius
    eye = centre + distance * np.array([np.sin(azimuth), lift, np.cos(azimuth)])
    focal = 0.5 * min(width * 1.25, height) * distance / (share * radius)
    lens = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    camera = Camera("portrait", lens, look_at(eye, centre, np.array([0.0, 1.0, 0.0])))
    drawn = picture(camera, mesh.vertices, mesh.faces, colours, paper)
    return np.asarray(cv2.resize(drawn, panel, interpolation=cv2.INTER_AREA), np.uint8)


def contact_sheet(rows: Sequence[Sequence[tuple[str, Resized]]], key: Sequence[str] = ()) -> Resized:
    """Arranges rows of labelled pictures in one picture, each scaled to fit the size ``PANEL``. A legend below explains
    the colours of ``difference``; ``key`` names the input and the model."""
    width = max(len(row) for row in rows)
    blank = np.full((PANEL[1], PANEL[0], 3), PAPER, np.uint8)
    drawn = [[legend(_panel(image), [(text, (255, 255, 255))] if text else []) for text, image in row] for row in rows]
    sheet = np.vstack([np.hstack(row + [blank] * (width - len(row))) for row in drawn])
    if not key:
        return sheet
    strip, font, at = np.full((KEY_PX, sheet.shape[1], 3), (45, 45, 45), np.uint8), cv2.FONT_HERSHEY_SIMPLEX, KEY_PX
    for text, colour in zip(key, (INPUT_COLOUR, FITTED_COLOUR), strict=True):
        cv2.rectangle(strip, (at - 24, 10), (at - 8, KEY_PX - 10), colour, cv2.FILLED)
        cv2.putText(strip, text, (at, KEY_PX - 12), font, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        at += cv2.getTextSize(text, font, 0.5, 1)[0][0] + 2 * KEY_PX
    return np.vstack([sheet, strip])


def _panel(image: ImageRgb) -> Resized:
    size = _fitted_size(image)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_CUBIC)
    out = np.full((PANEL[1], PANEL[0], 3), PAPER, np.uint8)
    left, top = (PANEL[0] - size[0]) // 2, (PANEL[1] - size[1]) // 2
    out[top : top + size[1], left : left + size[0]] = small
    return out


def _fitted_size(image: ImageRgb) -> tuple[int, int]:
    """Returns the width and height (px) of an image scaled to fill a panel."""
    scale = min(PANEL[0] / image.shape[1], PANEL[1] / image.shape[0])
    return max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))


def _smooth_distance(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Returns the distance (px) to a mask's contour, blurred so that a thin line along the contour is smooth; infinite
    beyond a margin around the mask."""
    distance = np.full(mask.shape, np.inf, np.float32)
    window = box_around(mask, MARGIN_PX)
    if mask[window].size:
        distance[window] = cv2.GaussianBlur(chamfer(mask[window].view(np.uint8)), (0, 0), 1.0)
    return distance


def _near(distance: Float32[np.ndarray, "h w"], line: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the flat indices of pixels that a contour line and its dark border may touch, and their distance (px)
    from the line's middle."""
    flat = distance.ravel()
    index = np.flatnonzero((flat < line / 2 + 1) & (flat > -line / 2 - 1))
    return index, np.abs(flat[index])


def _paint(
    canvas: ImageRgb, near: tuple[np.ndarray, np.ndarray], colour: tuple[int, int, int], width: float, strength: float
) -> None:
    index, distance = near
    pixels = canvas.reshape(-1, 3)
    alpha = strength * np.clip(width / 2 + 0.5 - distance, 0.0, 1.0)[:, None]
    pixels[index] = np.round(pixels[index] + alpha * (np.array(colour, np.float32) - pixels[index]))


def clay(
    mesh: Mesh,
    *,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
    azimuth_deg: float = AZIMUTH_DEG,
    panel: tuple[int, int] = CLAY_PANEL,
    box: Box | None = None,
    paper: tuple[int, int, int] = PAPER,
    darkest: float = DARKEST,
) -> Resized:
    """Draws a mesh (head frame, mm) with twofold supersampling.

    ``mesh``: the head. ``colours``: sRGB of its vertices; None draws grey clay. ``azimuth_deg``: viewing direction, 0
    from the front, positive from the head's left. ``panel``: width and height of the picture, px. ``box``: two opposite
    corners (mm) of the drawn part, so that several meshes can share a scale; None fits the mesh. ``paper``: sRGB of the
    background. ``darkest``: brightness of surfaces in full shadow.
    """
    fitting = (mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) if box is None else box
    shaded = lit(mesh, colours, darkest)
    return portrait(mesh, shaded, fitting, azimuth_deg, panel, paper=paper, lift=0.05, share=0.85)


def lit(
    mesh: Mesh, colours: UInt8[np.ndarray, "v 3"] | None = None, darkest: float = DARKEST
) -> UInt8[np.ndarray, "v 3"]:
    """Shades the colours of the vertices (grey clay if None) by a lamp at the head's right front."""
    cosine: Float[np.ndarray, " v"] = np.clip(mesh.normals() @ (LAMP / np.linalg.norm(LAMP)), 0.0, 1.0)
    base = SKIN if colours is None else colours.astype(float)
    return np.clip(base * (darkest + (1.0 - darkest) * cosine[:, None]), 0, 255).astype(np.uint8)
