"""Measures the time offsets between unsynchronised cameras with a clock on a screen that all cameras see.

The screen shows a row of ``SLOTS`` ArUco markers. At refresh n only the marker n % SLOTS changes. Every picture
therefore shows most markers sharply; markers that changed during the exposure are blurred and not decoded. The decoded
markers give the middle of the exposure with a resolution of one screen refresh; the mean of many shots is more precise.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.errors import InputError
from rig.formats.pictures.images import decode_image_file
from rig.messages.message import Message, compose

Grey = UInt8[np.ndarray, "h w"]
SLOTS, TURNS = 6, 40
PERIOD = SLOTS * TURNS  # refreshes after which the row repeats: 4 s at 60 Hz
CELLS, GAP = 6, 2  # of a marker with its black border, and of white beside it
MIN_READ = 3  # markers of a row: fewer may be chance
MAX_BLENDED = 3  # markers that change during an exposure: 50 ms at 60 Hz
UNIFORM_STD = 12**-0.5  # of a value that may lie anywhere within one refresh
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
PAGE = """<!doctype html><meta charset="utf-8"><title>eigenhead clock</title>
<style>html,body{margin:0;height:100%;background:#fff;font:16px sans-serif;text-align:center}
canvas{width:96vw;image-rendering:pixelated;margin-top:20vh}</style>
<canvas></canvas><p>refreshes a second: <span>measured</span></p>
<script>
const codes = CODES, slots = SLOTS, cells = CELLS, step = CELLS + GAP, inner = cells - 2;
const canvas = document.querySelector("canvas"), rate = document.querySelector("span");
canvas.width = slots * step; canvas.height = step;
const pen = canvas.getContext("2d");
pen.fillStyle = "#fff"; pen.fillRect(0, 0, canvas.width, canvas.height);
function draw(refresh) {
  const slot = refresh % slots, turn = Math.floor(refresh / slots) % TURNS, left = slot * step + GAP / 2;
  pen.fillStyle = "#000"; pen.fillRect(left, GAP / 2, cells, cells);
  pen.fillStyle = "#fff";
  for (let bit = 0; bit < inner * inner; bit++)
    if (codes[slot * TURNS + turn][bit] === "1")
      pen.fillRect(left + 1 + bit % inner, GAP / 2 + 1 + Math.floor(bit / inner), 1, 1);
}
let refresh = 0, begun = 0;
for (; refresh < slots; refresh++) draw(refresh);
function next(now) {
  begun = begun || now;
  draw(refresh++);
  if (refresh % 60 === 0) rate.textContent = (1000 * (refresh - slots - 1) / (now - begun)).toFixed(2);
  requestAnimationFrame(next);
}
requestAnimationFrame(next);
</script>
"""


@dataclass(frozen=True, slots=True)
class Skew:
    """Holds how much later a camera exposes than the mean of all cameras (ms), this offset's scatter over shots, and
    the standard deviation of the mean offset."""

    shots: int
    mean_ms: float
    scatter_ms: float
    std_ms: float


def clock_page() -> str:
    """Returns a self-contained HTML page that shows the clock and the screen's refresh rate in a browser."""
    bits = [_bits(code) for code in range(PERIOD)]
    page = PAGE.replace("CODES", json.dumps(["".join(map(str, of.ravel().tolist())) for of in bits]))
    for name, value in (("SLOTS", SLOTS), ("TURNS", TURNS), ("CELLS", CELLS), ("GAP", GAP)):
        page = page.replace(name, str(value))
    return page


def draw_row(refresh: int) -> UInt8[np.ndarray, "h w"]:
    """Draws the screen's row of markers after refresh number ``refresh``, one pixel for each marker cell."""
    row = np.full((CELLS + GAP, SLOTS * (CELLS + GAP)), 255, np.uint8)
    for slot in range(SLOTS):
        changed = refresh - (refresh - slot) % SLOTS
        left = slot * (CELLS + GAP) + GAP // 2
        marker = np.pad(_bits(slot * TURNS + changed // SLOTS % TURNS), 1)
        row[GAP // 2 : GAP // 2 + CELLS, left : left + CELLS] = 255 * marker
    return row


def _bits(code: int) -> UInt8[np.ndarray, "4 4"]:
    side = CELLS - 2
    return cv2.aruco.Dictionary.getBitsFromByteList(DICTIONARY.bytesList[code : code + 1], side).astype(np.uint8)


def read_refresh(image: Grey) -> float | None:
    """Returns the middle of a picture's exposure in screen refreshes, 0 to ``PERIOD``; None if the markers cannot be
    decoded."""
    _, found, _ = cv2.aruco.ArucoDetector(DICTIONARY).detectMarkers(image)
    if found is None or len(found) < MIN_READ:
        return None
    changed = {int(code) % TURNS * SLOTS + int(code) // TURNS for code in found.ravel() if code < PERIOD}
    for newest in changed:
        ages = [(newest - each) % PERIOD for each in changed]
        blended = SLOTS - len(ages)
        # the row holds SLOTS changes; those that are not read follow the newest, or a marker is hidden
        if max(ages) < SLOTS and blended <= MAX_BLENDED and sorted(ages) == list(range(len(ages))):
            return (newest + (blended + 1) / 2.0) % PERIOD
    return None


def measure_skews(refreshes: Mapping[str, Float[np.ndarray, " n"]], rate_hz: float) -> dict[str, Skew]:
    """Measures the time offset of each camera.

    Args:
        refreshes: by camera, the result of ``read_refresh`` for each shot; NaN if it is unknown.
        rate_hz: the screen's refresh rate.

    Returns only cameras that have shots in common with other cameras."""
    rows = np.array([*refreshes.values()])
    apart = (rows[:, None] - rows[None] + PERIOD / 2.0) % PERIOD - PERIOD / 2.0  # of each from each, in every shot
    read = np.isfinite(rows)
    refresh_ms = 1000.0 / rate_hz
    skews: dict[str, Skew] = {}
    for number, name in enumerate(refreshes):
        shots = read[number] & (read.sum(axis=0) > 1)
        if not shots.any():
            continue
        later = refresh_ms * np.nanmean(apart[number][:, shots], axis=0)
        scatter, places = float(later.std()), len(np.unique(later.round(3)))
        # readings that repeat err alike: an exposure whose place within a refresh stays may lie anywhere there
        std = float(np.hypot(scatter / len(later) ** 0.5, UNIFORM_STD * refresh_ms / places**0.5))
        skews[name] = Skew(len(later), float(later.mean()), scatter, std)
    return skews


def measure_shots(pictures: Mapping[str, Mapping[str, Path]], rate_hz: float) -> dict[str, Skew]:
    """Measures the time offsets of cameras whose shots are picture files. Raises InputError that lists every picture
    that cannot be decoded, and every camera that never shows the clock."""
    shots = sorted({shot for of in pictures.values() for shot in of})
    rows, faults = dict[str, Float[np.ndarray, " n"]](), list[Message]()
    for name, of in pictures.items():
        rows[name] = np.full(len(shots), np.nan)
        for shot, path in of.items():
            pixels, _, fault = decode_image_file(path, f"{name}/{path.name}", "grey")
            faults += [] if fault is None else [fault]
            if pixels is not None and (refresh := read_refresh(pixels)) is not None:
                rows[name][shots.index(shot)] = refresh
        if not np.isfinite(rows[name]).any():
            faults.append(compose("no-clock", camera=name))
    if faults:
        raise InputError("clock", faults)
    return measure_skews(rows, rate_hz)
