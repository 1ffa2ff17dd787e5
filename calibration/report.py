"""Writes the report of a calibration: one self-contained HTML page, and the same content as JSON."""

from collections.abc import Iterable
from html import escape

import numpy as np
from jaxtyping import Float

from calibration.adjustment.state import INTRINSICS
from calibration.result import Calibration
from rig.camera import Camera
from rig.messages.message import Message

PICTURE_WIDTH = 420.0  # of a camera's drawing on the page, CSS pixels
MAGNIFIED = 40.0  # residual vectors are drawn this many times longer
COVERAGE_CELLS = 8  # columns of the coverage map
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 66rem; padding: 0 1rem; color: #1b1f24 }
table { border-collapse: collapse; margin: .6rem 0 1.4rem } td, th { padding: .25rem .7rem; text-align: right }
th { border-bottom: 1px solid #999; font-weight: 600 } td:first-child, th:first-child { text-align: left }
tr:nth-child(even) td { background: #f4f5f7 } svg { background: #fbfbfc; border: 1px solid #ccc; margin-right: .8rem }
.good { color: #176f2c } .bad { color: #b3261e; font-weight: 600 } .none { color: #6b7280 }
.wide td { text-align: left }
"""


def report_page(calibration: Calibration) -> str:
    """Returns the report as an HTML page."""
    figures = calibration.figures()
    summary = (
        f"{len(calibration.rig)} cameras, {figures['corners']} corners used "
        f"({100 * figures['used_share']:.1f} % of those detected), 2D residual RMS <b>{figures['rms_px']:.3f} px</b>. "
        f"Front camera: {escape(calibration.front)}."
    )
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>Camera calibration</title>",
        f"<style>{STYLE}</style><h1>Camera calibration</h1><p>{summary}</p>",
        "<h2>Checks</h2>",
        _checks(calibration),
        write_list("Warnings", calibration.warnings),
        "<h2>Cameras</h2>",
        _camera_table(calibration),
        _offsets(calibration),
        "<h2>Parameters</h2>",
        _parameter_table(calibration),
        "<h2>Residuals and coverage</h2>",
        f"<p>Left: every used corner with its residual, drawn {MAGNIFIED:.0f} times longer (detected to projected). "
        "Right: corners per cell of the image; white cells were never covered, and the lens is a guess there.</p>",
        *(_camera_pictures(calibration, camera) for camera in calibration.rig),
        "</html>",
    ]
    return "\n".join(parts)


def _checks(calibration: Calibration) -> str:
    words = {True: ("good", "passed"), False: ("bad", "FAILED"), None: ("none", "not run")}
    rows = [
        f"<tr><td>{escape(check.name)}</td><td class='{words[check.passed][0]}'>{words[check.passed][1]}</td>"
        f"<td>{escape(check.detail.text)}{escape(f': {check.advice}') if check.passed is False else ''}</td></tr>"
        for check in calibration.checks
    ]
    return f"<table class='wide'>{''.join(rows)}</table>"


def write_list(title: str, lines: Iterable[Message | str]) -> str:
    """Returns an HTML list with a heading, or an empty text without lines."""
    items = "".join(f"<li>{escape(str(line))}</li>" for line in lines)
    return f"<h2>{title}</h2><ul>{items}</ul>" if items else ""


def _camera_table(calibration: Calibration) -> str:
    head = ("camera", "views", "corners", "RMS px", "alone px", "uncertainty at the subject px", "centre mm")
    rows = [
        (
            name,
            str(row["views"]),
            str(row["corners"]),
            f"{row['rms_px']:.3f}",
            f"{row['alone_rms_px']:.3f}",
            f"{row['pose_sigma_px']:.3f}",
            ", ".join(f"{value:.1f}" for value in calibration.rig[name].centre_world),
        )
        for name, row in calibration.figures()["cameras"].items()
    ]
    return table(head, rows)


def _offsets(calibration: Calibration) -> str:
    offsets = calibration.offsets
    if offsets is None:
        return ""
    said = "used" if calibration.offsets_used else "not used: they explain too little"
    rows = [
        (name, f"{value:+.4f}", f"{sigma:.4f}")
        for name, value, sigma in zip(calibration.rig.names, offsets.offsets, offsets.sigma, strict=True)
    ]
    text = f"RMS {offsets.rms_without_px:.3f} px without, {offsets.rms_with_px:.3f} px with them ({said})."
    return f"<h3>Time offsets, in shots</h3><p>{text}</p>" + table(("camera", "offset", "+-"), rows)


def _parameter_table(calibration: Calibration) -> str:
    """Returns an HTML table of each camera's lens and pose with standard deviations (in the subject's gauge)."""
    head = ("camera", *INTRINSICS, "turn x y z, mrad", "shift x y z, mm")
    rows = []
    for camera in calibration.rig:
        values = camera.intrinsics.values()
        sigmas = calibration.intrinsics_sigma[camera.name]
        lens = [
            f"{value:.{2 if i < 4 else 5}f} &plusmn; {sigma:.2g}"
            for i, (value, sigma) in enumerate(zip(values, sigmas, strict=True))
        ]
        assert camera.covariance is not None
        spread = np.sqrt(np.diag(camera.covariance))
        turn = ", ".join(f"&plusmn; {1000 * value:.2g}" for value in spread[:3])
        shift = ", ".join(f"&plusmn; {value:.2g}" for value in spread[3:])
        rows.append((camera.name, *lens, turn, shift))
    return table(head, rows)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Returns an HTML table. The table cells ``rows`` are HTML and are not escaped."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def _camera_pictures(calibration: Calibration, camera: Camera) -> str:
    observed = [miss for (name, _), miss in calibration.misses.items() if name == camera.name]
    pixels = np.concatenate([corners for _, corners, _ in observed])
    misses = np.concatenate([miss for _, _, miss in observed])
    return f"<h3>{escape(camera.name)}</h3>{_vectors(camera, pixels, misses)}{_coverage(camera, pixels)}"


def _frame(camera: Camera, inside: str) -> str:
    k = camera.intrinsics
    height = PICTURE_WIDTH * k.height / k.width
    return (
        f"<svg width='{PICTURE_WIDTH:.0f}' height='{height:.0f}' viewBox='-0.5 -0.5 {k.width} {k.height}' "
        f"role='img'>{inside}</svg>"
    )


def _vectors(camera: Camera, pixels: Float[np.ndarray, "n 2"], misses: Float[np.ndarray, "n 2"]) -> str:
    width = camera.intrinsics.width / PICTURE_WIDTH
    tips = pixels + MAGNIFIED * misses
    strokes = "".join(
        f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for (x, y), (u, v) in zip(pixels.tolist(), tips.tolist(), strict=True)
    )
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in pixels.tolist())
    paths = f"<path d='{strokes}' stroke='#b3261e' stroke-width='{width:.2f}' fill='none'/>"
    paths += f"<path d='{dots}' stroke='#1f4e8c' stroke-width='{2.4 * width:.2f}' stroke-linecap='round'/>"
    return _frame(camera, paths)


def _coverage(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> str:
    k = camera.intrinsics
    rows = max(1, round(COVERAGE_CELLS * k.height / k.width))
    edges = np.linspace(-0.5, k.width - 0.5, COVERAGE_CELLS + 1), np.linspace(-0.5, k.height - 0.5, rows + 1)
    counts = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=edges)[0]
    side = k.width / COVERAGE_CELLS, k.height / rows
    cells = []
    for (column, row), count in np.ndenumerate(counts):
        x, y = edges[0][column], edges[1][row]
        strength = 0.85 * min(1.0, np.sqrt(count / 40.0))
        cells.append(
            f"<rect x='{x:.1f}' y='{y:.1f}' width='{side[0]:.1f}' height='{side[1]:.1f}' fill='#1f4e8c' "
            f"fill-opacity='{strength:.2f}' stroke='#ccc'/>"
            f"<text x='{x + side[0] / 2:.1f}' y='{y + side[1] / 2:.1f}' font-size='{0.22 * side[1]:.1f}' "
            f"text-anchor='middle' dominant-baseline='central'>{int(count)}</text>"
        )
    return _frame(camera, "".join(cells))
