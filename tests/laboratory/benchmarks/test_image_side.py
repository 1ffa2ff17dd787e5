"""Timings of the image side on eleven 1024 x 768 images: segmentation < 0.6 s, texture < 0.5 s, hull < 2 s on 2 cores.

pytest -o addopts="-ra --strict-markers --import-mode=importlib" tests/laboratory/benchmarks/test_image_side.py
"""

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from pipeline.geometry.raster import depth_maps
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull import hull_extent, visual_hull
from pipeline.segmentation.segment import segment
from pipeline.settings import SegmentationSettings, TextureSettings
from pipeline.texturing.vertex_colours import texture
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.mesh import Mesh
from rig.rig import Rig
from tests.support.shared_data import shared


@pytest.fixture(scope="module")
def scan() -> tuple[Capture, Rig, dict[str, Silhouette]]:
    capture, rig = read_capture(shared("data/captures/scan-a"))
    return capture, rig, segment(capture, rig, SegmentationSettings(), report=lambda *_: None)


def test_segmentation(benchmark: BenchmarkFixture, scan: tuple[Capture, Rig, dict[str, Silhouette]]) -> None:
    capture, rig, _ = scan
    benchmark.pedantic(
        segment, (capture, rig, SegmentationSettings()), {"report": lambda *_: None}, rounds=5, warmup_rounds=1
    )


def test_texture(benchmark: BenchmarkFixture, scan: tuple[Capture, Rig, dict[str, Silhouette]]) -> None:
    capture, rig, silhouettes = scan
    model = load_model()
    head = Mesh(model.vertices(np.zeros(1)) + hull_extent(silhouettes, rig)[0], model.levels["full"].faces)
    normals = head.normals()
    arguments = (head, normals, capture, silhouettes, rig, depth_maps(rig, head))
    benchmark.pedantic(texture, arguments, {"settings": TextureSettings()}, rounds=5, warmup_rounds=1)


def test_visual_hull(benchmark: BenchmarkFixture, scan: tuple[Capture, Rig, dict[str, Silhouette]]) -> None:
    _, rig, silhouettes = scan
    benchmark.pedantic(visual_hull, (silhouettes, rig), rounds=5, warmup_rounds=1)
