"""The experiment on light: its measures, and once the whole."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.render.renderer import Renderer
from tests.laboratory.experiments.records import Bench
from tests.laboratory.experiments.surface.light import levelled, light


def test_levelled_images_differ_by_no_overall_colour() -> None:
    rng = np.random.default_rng(5)
    one = rng.uniform(0.05, 0.4, (999, 3))
    codes, dimmer = (np.rint(255 * srgb_from_linear(x)).astype(np.uint8) for x in (one, one * (0.8, 0.9, 0.7)))
    found = levelled(dimmer, codes)
    assert np.abs(found.astype(int) - codes).max() <= 2  # both were rounded
    assert np.median(linear_from_srgb(found / 255.0), axis=0) == pytest.approx(
        np.median(linear_from_srgb(codes / 255.0), axis=0), rel=0.02
    )


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(1200)  # eight whole jobs, beside another test
def test_albedos_of_three_lights_differ_by_at_most_half(tmp_path: Path) -> None:
    with Renderer.create() as renderer:
        found = light(load_model(), renderer=renderer, bench=Bench(folder=tmp_path))
    assert found["figures"]["ratio"] < 0.5
    assert found["figures"]["ratio_level"] < 0.5
    assert found["figures"]["chart_ratio"] < 0.4
    assert found["figures"]["chart_albedo"] < 0.8 * found["figures"]["albedo"]
    assert (tmp_path / "light-00.png").is_file()
