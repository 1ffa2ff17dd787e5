"""Masks from clean plates against true ones, of pictures as they are and made smaller: overlap, contour, what is said.

python -m tests.laboratory.benchmarks.plate_masks
python -m tests.laboratory.benchmarks.plate_masks --captures scan-a-skin --sizes 1 0.75 0.5 0.25 --views
python -m tests.laboratory.benchmarks.plate_masks --sizes 0.5 --noise 3 --exposure 0.9 --jpeg 85

Pictures and plates are made smaller by the mean over each new pixel's area, the rig with them. Whatever the size,
contours are compared in pixels of the whole one, from every point of the true contour to the mask's: sizes compare.
What a mask has too much is in the overlap.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.imaging.silhouette import Silhouette
from pipeline.segmentation.segment import segment
from pipeline.settings import SegmentationSettings
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.rig import Rig
from tests.pipeline.segmentation.test_segment import true_mask
from tests.support.noisy_captures import noisier
from tests.support.shared_data import shared

CAPTURES = ("scan-a", "draw-b", "scan-a-skin", "beard-smile", "three-brows", "circle-hair")
FAR_PX = 4.0  # of the whole size, 1.5 mm of a head: from there on a contour is wrong, and not only blurred


@dataclass(frozen=True)
class Row:
    """One view: overlap, distances from the true contour to the mask's (px of the whole size), what the view says."""

    view: str
    overlap: float
    off_px: np.ndarray
    silhouette: Silhouette

    @property
    def far(self) -> float:
        return float((self.off_px > FAR_PX).mean())

    @property
    def weak(self) -> float:
        """What the program says of the contour: the share that hardly differs from the background."""
        return float(np.asarray(self.silhouette.quality.figures.get("weak_share", 1.0)))

    def line(self) -> str:
        quality = self.silhouette.quality
        return (
            f"{self.overlap:.4f} {np.median(self.off_px):.2f} {np.sqrt((self.off_px**2).mean()):.2f} "
            f"{np.quantile(self.off_px, 0.95):.2f} {self.far:.3f} weak {self.weak:.3f} "
            f"{'' if quality.usable else 'left out '}{'; '.join(map(str, quality.warnings))}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", nargs="+", default=CAPTURES)
    parser.add_argument("--sizes", nargs="+", type=float, default=(1.0, 0.5))
    parser.add_argument(
        "--noise", type=float, default=0.0, help="levels that are added to the smaller pictures and plates"
    )
    parser.add_argument("--exposure", type=float, default=1.0, help="light of the shot by that of the plate")
    parser.add_argument("--jpeg", type=int, help="quality with which the smaller pictures and plates are packed")
    parser.add_argument("--views", action="store_true", help="a line a view")
    arguments = parser.parse_args()
    write = sys.stdout.write
    write("capture size: IoU median, worst; contour px median, RMS, 95 %, share beyond 4 px; left out; said\n")
    for name in arguments.captures:
        capture, rig = read_capture(shared(f"data/captures/{name}"))
        for size in arguments.sizes:
            small, smaller_rig = smaller(capture, rig, size)
            small = worse(small, arguments.noise, arguments.exposure, arguments.jpeg)
            rows = compare(name, small, smaller_rig)
            write(f"{name} {size:g}: {summary(rows)}\n")
            write("".join(f"  {row.view} {row.line()}\n" for row in rows if arguments.views))
            sys.stdout.flush()


def smaller(capture: Capture, rig: Rig, size: float) -> tuple[Capture, Rig]:
    """The capture with pictures and plates as means over areas; ``size`` must leave whole pixels."""
    if size == 1:
        return capture, rig
    return _each(
        capture, lambda picture: cv2.resize(picture, None, fx=size, fy=size, interpolation=cv2.INTER_AREA)
    ), rig.scaled(size)


def worse(capture: Capture, noise: float, exposure: float, jpeg: int | None) -> Capture:
    """The capture with noise, with another exposure of its shot (but not of its plates), and packed as JPEG."""
    if exposure != 1:
        table = np.clip(np.rint(np.arange(256) * exposure ** (1 / 2.3)), 0, 255).astype(np.uint8)
        capture = replace(capture, images={name: table[image] for name, image in capture.images.items()})
    if noise:
        capture = noisier(capture, noise)
    return _each(capture, lambda picture: _packed(picture, jpeg)) if jpeg else capture


def _packed(picture: np.ndarray, quality: int) -> np.ndarray:
    data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[:, :, ::-1])


def _each(capture: Capture, change: Callable[[np.ndarray], np.ndarray]) -> Capture:
    images = {name: change(image) for name, image in capture.images.items()}
    plates = {name: tuple(map(change, several)) for name, several in capture.backgrounds.items()}
    return replace(capture, images=images, backgrounds=plates)


def compare(name: str, capture: Capture, rig: Rig) -> list[Row]:
    silhouettes = segment(capture, rig, SegmentationSettings(), report=lambda *_: None)
    return [compare_view(name, view, silhouettes[view]) for view in rig.names]


def compare_view(name: str, view: str, silhouette: Silhouette) -> Row:
    """Compares one silhouette, of any size, with the true mask of the whole size."""
    truth = true_mask(view, name)
    size = silhouette.mask.shape[1] / truth.shape[1]
    at = (contour_points(truth) + 0.5) * size - 0.5
    x, y = (np.ascontiguousarray(at[:, k], np.float32)[None] for k in (0, 1))
    off = np.abs(cv2.remap(silhouette.distance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]) / size
    small = cv2.resize(truth.astype(np.float32), silhouette.mask.shape[::-1], interpolation=cv2.INTER_AREA) >= 0.5
    overlap = np.count_nonzero(silhouette.mask & small) / np.count_nonzero(silhouette.mask | small)
    return Row(view, overlap, off, silhouette)


def contour_points(mask: np.ndarray) -> np.ndarray:
    """Points half-way between neighbours that a mask separates, (x, y)."""
    across, down = np.argwhere(mask[:, 1:] != mask[:, :-1]), np.argwhere(mask[1:] != mask[:-1])
    return np.concatenate([across[:, ::-1] + (0.5, 0.0), down[:, ::-1] + (0.0, 0.5)])


def summary(rows: list[Row]) -> str:
    overlap, off = np.array([row.overlap for row in rows]), np.concatenate([row.off_px for row in rows])
    out, said = (
        sum(not r.silhouette.quality.usable for r in rows),
        sum(bool(r.silhouette.quality.warnings) for r in rows),
    )
    return (
        f"{np.median(overlap):.4f} {overlap.min():.4f}; {np.median(off):.2f} {np.sqrt((off**2).mean()):.2f} "
        f"{np.quantile(off, 0.95):.2f} {(off > FAR_PX).mean():.4f}; {out}; {said}"
    )


if __name__ == "__main__":
    main()
