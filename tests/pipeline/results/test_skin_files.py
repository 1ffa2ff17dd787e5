"""The maps of the skin as files, and what the report says of them."""

import json
from pathlib import Path

import cv2
import numpy as np

from pipeline.results.head_files import write_skin_maps
from pipeline.results.report import skin_document
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout
from pipeline.texturing.pores.skin_maps import SkinMaps, codes_of


def maps() -> SkinMaps:
    heights = np.linspace(-0.1, 0.1, 64, dtype=np.float32).reshape(8, 8)
    return SkinMaps(codes_of(heights), np.full((8, 8, 3), (128, 127, 255), np.uint8), (0.5, 0.25), ("a", "b"))


def test_a_program_reads_millimetres_by_what_the_report_says(tmp_path: Path) -> None:
    image = np.zeros((8, 8, 3), np.uint8)
    image[..., 0] = 200
    atlas = Atlas(Layout(np.zeros((3, 2)), np.array([[0, 1, 2]]), np.arange(3)), image)
    write_skin_maps(tmp_path, atlas, maps())
    document = json.loads(json.dumps(skin_document(maps())))
    stored = cv2.imread(str(tmp_path / "displacement.png"), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == np.uint16
    heights = (stored.astype(float) - document["mid_code"]) * document["mm_per_code"]
    np.testing.assert_allclose(heights.ravel(), np.linspace(-0.1, 0.1, 64), atol=2e-5)
    for name, first in (("colour", (0, 0, 200)), ("normals", (255, 127, 128))):  # blue first
        read = cv2.imread(str(tmp_path / f"{name}.png"))
        assert read is not None
        assert tuple(read[0, 0].tolist()) == first
    assert document["repeated"] == [0.5, 0.25]
    assert document["views"] == ["a", "b"]
