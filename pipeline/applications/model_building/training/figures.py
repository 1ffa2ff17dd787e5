"""Draws a head model: its first modes (the paper's figure 2), the steps of correspondence (figure 3), and curves of its
quality.

Pictures are drawn in software, so that machines without graphics card and plotting library give the same pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.applications.model_building.correspondence.correspondence import (
    CylinderIndex,
    common_frame,
    on_reference,
    points_at,
    prepared,
    warp_and_resample,
)
from pipeline.applications.model_building.correspondence.scans import Scan
from pipeline.applications.model_building.training.training import USED_MODES, compactness, generalisation, specificity
from pipeline.geometry.projection import picture
from pipeline.head_model.landmarks import NAMES
from pipeline.head_model.model import HeadModel
from pipeline.head_model.pca import Components
from rig.camera import Camera, Intrinsics
from rig.formats.pictures.images import encode_image
from rig.geometry import look_at, rotation_from_vector
from rig.mesh import vertex_normals
from rig.progress import Progress

_JUMP_MM = 8.0  # neighbouring samples farther apart lie on two surfaces ...
_STEEPEST = 4.0  # ... unless the grid is coarse: 4 mm apart, the side of a nose would come out as a hole


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanner:
    """Holds the properties of a simulated scanner and of its subjects. Lengths in mm."""

    spacing_mm: float = 1.0
    noise_mm: float = 0.1
    landmark_noise_mm: float = 0.5
    holes: int = 3  # in the hair
    hole_mm: float = 12.0  # largest radius of one
    ear_holes: bool = True
    turn_rad: float = 0.05  # standard deviation: the subject does not sit exactly straight
    shift_mm: float = 5.0


def scan_head(
    name: str,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    landmarks: Mapping[str, int],
    scanner: Scanner,
    rng: np.random.Generator,
) -> Scan:
    """Simulates a raw scan of a head (head frame, mm); the scan is slightly rotated and shifted."""
    angles, heights = _grid(vertices, scanner, rng)
    columns, rows = np.meshgrid(angles, heights)
    radii = CylinderIndex(vertices, faces).cast(columns.ravel(), rows.ravel())
    radii = radii + scanner.noise_mm * rng.standard_normal(len(radii))
    points = points_at(columns.ravel(), rows.ravel(), radii)
    marks = {n: vertices[v] + scanner.landmark_noise_mm * rng.standard_normal(3) for n, v in landmarks.items()}
    valid = np.isfinite(radii) & ~_swallowed(points, {n: vertices[v] for n, v in landmarks.items()}, scanner, rng)
    mesh = _grid_faces(valid.reshape(rows.shape), points, max(_JUMP_MM, _STEEPEST * scanner.spacing_mm))
    used, local = np.unique(mesh, return_inverse=True)
    turn = rotation_from_vector(scanner.turn_rad * rng.standard_normal(3))
    shift = scanner.shift_mm * rng.standard_normal(3)
    place = points[used] @ turn.T + shift
    return Scan(name, place, local.reshape(-1, 3).astype(np.int32), {n: p @ turn.T + shift for n, p in marks.items()})


def _grid(
    vertices: Float[np.ndarray, "V 3"], scanner: Scanner, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " A"], Float[np.ndarray, " H"]]:
    """Returns the angles and heights at which a scan samples a head, about ``spacing_mm`` apart on a head of 90 mm
    radius and different for each scan."""
    spacing_mm = scanner.spacing_mm * rng.uniform(0.95, 1.05)
    count = round(2 * np.pi * 90 / spacing_mm)
    angles = -np.pi + 2 * np.pi * (np.arange(count) + rng.uniform()) / count
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    return angles, np.arange(low + spacing_mm * rng.uniform(), high, spacing_mm)


def _swallowed(
    points: Float[np.ndarray, "N 3"],
    marks: Mapping[str, Float[np.ndarray, " 3"]],
    scanner: Scanner,
    rng: np.random.Generator,
) -> Bool[np.ndarray, " N"]:
    """Returns a mask of the samples that the simulated scanner loses in hair or ears."""
    lost = np.zeros(len(points), bool)
    hair_line = marks["glabella"][1] + 45.0
    hairy = np.flatnonzero((points[:, 1] > hair_line) | ((points[:, 2] < -20) & (points[:, 1] > 0)))
    for centre in points[rng.choice(hairy, scanner.holes)] if len(hairy) else ():
        lost |= np.linalg.norm(points - centre, axis=1) < rng.uniform(0.3, 1.0) * scanner.hole_mm
    if scanner.ear_holes:
        for side in ("left", "right"):
            behind = marks[f"tragion_{side}"] + [0.0, 0.0, -18.0]
            lost |= np.linalg.norm(points - behind, axis=1) < rng.uniform(8.0, 14.0)
    return lost


def _grid_faces(
    valid: Bool[np.ndarray, "H A"], points: Float[np.ndarray, "N 3"], jump_mm: float
) -> Int[np.ndarray, "F 3"]:
    """Returns triangles between neighbouring samples, also across the angle's seam; no edge reaches ``jump_mm``."""
    rows, columns = valid.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    here, right = index[:-1], np.roll(index, -1, 1)[:-1]
    up, across = index[1:], np.roll(index, -1, 1)[1:]
    faces = np.concatenate([np.stack([here, right, across], -1), np.stack([here, across, up], -1)]).reshape(-1, 3)
    faces = faces[valid.ravel()[faces].all(1)]
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1)
    return faces[longest < jump_mm]


Image = UInt8[np.ndarray, "H W 3"]

PANEL = (260, 320)  # width, height of one head
SKIN, VOID = np.array([214.0, 190.0, 172.0]), np.array([196.0, 60.0, 40.0])
INK, GRID, PAPER = (40, 40, 40), (222, 222, 222), (255, 255, 255)
LINES = ((0, 114, 178), (213, 94, 0), (0, 158, 115))  # Okabe and Ito: distinct for every kind of colour vision
_LIGHT = np.array([0.35, 0.45, 0.82])
_FIELD_MM = 365.0  # height of every panel: one scale for all, since size is one of the modes
_DISTANCE_MM = 1600.0
_BEHIND_RAD = 2.4


def show_model(model: HeadModel, folder: Path, *, modes: int, report: Progress) -> list[Path]:
    """Writes modes.png, correspondence.png and, if the model's training heads are known, curves.png into a folder."""
    report("drawing modes", 0.0)
    pictures = {"modes.png": modes_figure(model, modes)}
    report("drawing correspondence", 0.0)
    pictures["correspondence.png"] = correspondence_figure(model)
    if len(model.scores):
        pictures["curves.png"] = curves_figure(model, report)
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in pictures.items():
        (folder / name).write_bytes(encode_image(".png", image))
    return [folder / name for name in pictures]


def shaded(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    marked: Bool[np.ndarray, " V"] | None = None,
    azimuth_rad: float = 0.45,
) -> Image:
    """Draws one head (head frame, mm) lit from the upper left; ``marked`` vertices are red."""
    turn = np.array([np.sin(azimuth_rad), 0.0, np.cos(azimuth_rad)])
    width, height = 2 * PANEL[0], 2 * PANEL[1]
    focal = height * _DISTANCE_MM / _FIELD_MM
    centre = np.array([0.0, -15.0, 0.0])
    lens = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    camera = Camera("figure", lens, look_at(centre + _DISTANCE_MM * turn, centre, np.array([0.0, 1.0, 0.0])))
    right = np.array([turn[2], 0.0, -turn[0]])
    light = _LIGHT[2] * turn + _LIGHT[1] * np.array([0.0, 1.0, 0.0]) - _LIGHT[0] * right
    brightness = 0.35 + 0.65 * np.clip(vertex_normals(vertices, faces) @ light, 0, 1)
    tone = np.where(marked[:, None], VOID, SKIN) if marked is not None else SKIN
    colours = np.clip(brightness[:, None] * tone * 1.1, 0, 255).astype(np.uint8)
    return cv2.resize(picture(camera, vertices, faces, colours, PAPER), PANEL, interpolation=cv2.INTER_AREA)


def modes_figure(model: HeadModel, modes: int) -> Image:
    """Draws the paper's figure 2: one row for each mode, with heads at -3, 0 and +3 standard deviations."""
    faces = model.levels["full"].faces
    rows = []
    for k in range(min(modes, len(model.modes))):
        z = np.eye(k + 1)[k]
        panels = []
        for step in (-3, 0, 3):
            drawn = shaded(model.vertices(step * z), faces)
            panels.append(_titled(drawn, f"mode {k + 1}: {step:+d} sd" if step else "mean"))
        rows.append(np.hstack(panels))
    return np.vstack(rows)


def correspondence_figure(model: HeadModel) -> Image:
    """Draws the paper's figure 3: reference, target scan, warped reference, and resampled head with its holes in red.

    Each head is drawn from the front and from behind. The reference and the target scan are random heads of the model,
    scanned by the simulated scanner with holes."""
    rng = np.random.default_rng(3)
    count = min(20, len(model.modes))
    faces = model.levels["full"].faces
    scanner = Scanner(spacing_mm=2.0, holes=5, hole_mm=20.0)
    scans = [
        scan_head("drawn", model.vertices(rng.standard_normal(count)), faces, model.landmarks, scanner, rng)
        for _ in range(2)
    ]
    frames = common_frame(scans, model)
    reference, target = (prepared(scan, frame) for scan, frame in zip(scans, frames, strict=True))
    index = np.array([model.landmarks[name] for name in NAMES])
    shape = on_reference(reference, model)
    cylinder = CylinderIndex(target.vertices, scans[1].faces)
    warped, sampled, void = warp_and_resample(shape, index, target.marks, cylinder)
    cage = model.levels["cage"].faces
    steps = (
        ("reference", shape, cage, None),
        ("target scan", target.vertices, scans[1].faces, None),
        ("warped reference", warped, cage, None),
        (f"resampled, {void.mean():.0%} void", sampled, cage, void),
    )
    front = [_titled(shaded(v, f, marked), title) for title, v, f, marked in steps]
    return np.vstack([np.hstack(front), np.hstack([shaded(v, f, marked, _BEHIND_RAD) for _, v, f, marked in steps])])


def curves_figure(model: HeadModel, report: Progress) -> Image:
    """Draws compactness, generalisation (leave one out) and specificity as curves over the number of modes."""
    counts = [
        c for c in (1, 2, 5, 10, 20, 40, USED_MODES, 100, 137) if c <= min(len(model.modes), len(model.scores) - 1)
    ]
    region = model.levels["cage"].face_region
    mean, modes, scores = (array.astype(float) for array in (model.mean, model.modes, model.scores))
    components = Components(mean, modes, np.linalg.norm(modes.reshape(len(modes), -1), axis=1), scores)
    compact = compactness(model.sigma)
    apart = generalisation(components, region, counts, report=report)
    heads = (model.mean + np.tensordot(model.scores, model.modes, 1)).astype(float)
    special = {c: specificity(components.mean, components.modes[:c], heads, region, draws=30) for c in counts}
    charts = [
        ("compactness: share of variance", {k + 1: float(v) for k, v in enumerate(compact)}),
        ("generalisation: leave one out, mm", apart),
        ("specificity: random draw to nearest head, mm", special),
    ]
    return np.hstack([chart(title, values, colour) for (title, values), colour in zip(charts, LINES, strict=True)])


def chart(title: str, values: Mapping[int, float], colour: tuple[int, int, int]) -> Image:
    """Draws one curve over the number of modes, from zero up, with axes."""
    width, height, left, bottom, top = 420, 320, 55, 275, 40
    canvas = np.full((height, width, 3), PAPER, np.uint8)
    most, highest = max(values), max(values.values())
    step = next(s for s in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0) if highest / s <= 6)
    ceiling = step * np.ceil(highest / step - 1e-9)

    def at(modes: float, value: float) -> tuple[int, int]:
        return round(left + (width - left - 20) * modes / most), round(bottom - (bottom - top) * value / ceiling)

    for k in range(round(ceiling / step) + 1):
        place = at(0, k * step)
        cv2.line(canvas, place, at(most, k * step), GRID, 1)
        _text(canvas, f"{k * step:.1f}", (10, place[1] + 4))
    for modes in range(0, most + 1, 20 if most > 40 else max(1, most // 5)):
        _text(canvas, str(modes), (at(modes, 0)[0] - 8, bottom + 18))
    points: Sequence[tuple[int, int]] = [at(m, v) for m, v in sorted(values.items())]
    cv2.polylines(canvas, [np.array(points, np.int32)], isClosed=False, color=colour, thickness=2, lineType=cv2.LINE_AA)
    if len(points) < 20:
        for point in points:
            cv2.circle(canvas, point, 4, colour, -1, cv2.LINE_AA)
    _text(canvas, title, (left, 22), 0.48)
    _text(canvas, "modes", (width - 70, bottom + 36))
    return canvas


def _titled(image: Image, title: str) -> Image:
    out = image.copy()
    _text(out, title, (8, 18), 0.48)
    return out


def _text(image: Image, text: str, at: tuple[int, int], size: float = 0.42) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
