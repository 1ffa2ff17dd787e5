"""Skin and cameras as real ones are: each option does what it says and nothing else, and none is on by itself."""

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from rig.errors import InputError
from rig.mesh import face_normals
from rig.studio.scene.anatomy import anatomy
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.scene.skin_texture import DRY, oily_zones
from rig.studio.scene.subject import scatter_light
from rig.studio.sensor.preset import PRESET, REALISM, made_real, realism_names
from rig.studio.sensor.sensor import Sensor, compress_jpeg, expose, through_mosaic
from tests.rig.studio.test_images import egg_head
from tests.support.scenes import ellipsoid
from tests.support.small_studio import CLEAN

if TYPE_CHECKING:
    from rig.render.renderer import Renderer

BARE = replace(CLEAN, texture=True)


@cache
def shot(renderer: "Renderer", *names: str) -> SimulatedCapture:
    rig = default_layout().subset(("cam00", "cam03")).scaled(0.5)
    preset = made_real(BARE, names)
    return simulate(egg_head(), rig, preset, np.random.default_rng(3), renderer=renderer)


def skin(capture: SimulatedCapture, name: str = "cam00") -> np.ndarray:
    """Linear light of one view's subject."""
    view = capture.scene.views[name]
    return np.where(view.mask[:, :, None], view.subject[:, :, :3], 0.0)


def test_names_add_up_and_unknown_ones_are_refused() -> None:
    both = made_real(PRESET, ("oily", "jpeg"))
    assert both == replace(PRESET, oil=1.0, jpeg_quality=92)
    assert realism_names("all") == tuple(REALISM)
    assert realism_names(None) == ()
    with pytest.raises(InputError, match="shiny is not one of smooth, oily"):
        made_real(PRESET, realism_names("smooth,shiny"))


def test_light_spreads_and_none_is_lost() -> None:
    """A spot on a head's size: its second moment grows by the spread's square along each of two directions."""
    mesh = ellipsoid(5)
    front = mesh.vertices[:, 2] > 0.0
    spot = np.exp(-0.5 * (mesh.vertices[:, :2] ** 2).sum(axis=1) / 6.0**2) * front
    light = np.repeat(spot[:, None], 3, axis=1)
    found = scatter_light(mesh.vertices, mesh.faces, light, (8.0, 4.0, 0.0))
    double = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    area = np.bincount(mesh.faces.ravel(), np.repeat(double / 6.0, 3), len(spot))
    assert area @ found == pytest.approx(area @ light, rel=1e-6)
    assert np.array_equal(found[:, 2], light[:, 2])
    assert found.min() > -1e-9

    def variance(values: np.ndarray) -> float:
        return float((area * values) @ mesh.vertices[:, 0] ** 2 / (area @ values))

    for channel, spread in ((0, 8.0), (1, 4.0)):
        assert variance(found[:, channel]) - variance(spot) == pytest.approx(spread**2, rel=0.15)


def test_oil_is_on_nose_and_forehead_more_than_beside_them() -> None:
    head = egg_head()
    body = anatomy(head.mesh.vertices, head.landmarks)
    places = np.array([head.landmarks["pronasale"], head.landmarks["glabella"] + (0.0, 28.0, -4.0), (0.0, 0.0, -96.0)])
    nose, forehead, back = oily_zones(places, body)
    assert nose == pytest.approx(1.0)
    assert forehead == pytest.approx(1.0)
    assert back == pytest.approx(DRY, abs=1e-3)


@pytest.mark.gl
def test_highlights_are_sharp_and_move_with_the_camera(renderer: "Renderer") -> None:
    plain, oily = shot(renderer), shot(renderer, "oily")
    added = {name: (skin(oily, name) - skin(plain, name)).mean(axis=2) for name in plain.rig.names}
    assert all(light.min() > -1e-3 for light in added.values())
    assert all(light.max() > 0.3 for light in added.values())
    assert all((light > 0.5 * light.max()).sum() < 0.02 * (light != 0.0).sum() for light in added.values())
    points, seen = oily.scene.head.vertices, []
    for name, light in added.items():
        row, column = np.unravel_index(light.argmax(), light.shape)
        apart = np.linalg.norm(oily.rig[name].project(points) - (column, row), axis=1)
        towards = (oily.scene.head.normals() @ -oily.rig[name].axis_world) > 0.0
        seen.append(points[towards][apart[towards].argmin()])
    assert np.linalg.norm(seen[0] - seen[1]) > 15.0, "on another place of the skin in another camera"


@pytest.mark.gl
def test_smooth_skin_has_less_contrast_at_the_size_of_pixels(renderer: "Renderer") -> None:
    def contrast(capture: SimulatedCapture) -> float:
        light, inside = skin(capture)[:, :, 1], capture.scene.views["cam00"].mask
        step = np.abs(np.diff(light, axis=1))[:, 1:-1]
        well_inside = np.all([inside[:, k : k + step.shape[1]] for k in range(3)], axis=0)
        return float(np.quantile(step[well_inside], 0.5))

    assert contrast(shot(renderer, "smooth")) < 0.5 * contrast(shot(renderer))


@pytest.mark.gl
def test_scattering_fills_shadows_with_red(renderer: "Renderer") -> None:
    plain, spread = skin(shot(renderer)), skin(shot(renderer, "scattering"))
    inside = plain.sum(axis=2) > 0.0
    change = np.log(spread[inside] / plain[inside])
    red, green, blue = np.quantile(change, 0.99, axis=0)
    assert red > 0.02, "the egg shades itself about its nose alone"
    assert red > 1.5 * green > 1.5 * blue
    assert spread[inside].mean(axis=0) == pytest.approx(plain[inside].mean(axis=0), rel=0.05)


def test_a_mosaic_keeps_flat_colours_and_blurs_what_is_finer_than_it() -> None:
    flat = np.full((32, 48, 3), (0.2, 0.5, 0.7), np.float32)
    assert through_mosaic(flat)[2:-2, 2:-2] == pytest.approx(flat[2:-2, 2:-2], abs=1e-3)
    rng = np.random.default_rng(2)
    noise = through_mosaic(np.clip(0.5 + 0.1 * rng.standard_normal((64, 64, 3)), 0, 1).astype(np.float32))[
        4:-4, 4:-4, 0
    ]
    beside = np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]
    assert beside > 0.3, "neighbours share what was interpolated"


def test_read_out_noise_is_there_without_light() -> None:
    dark = np.full((64, 64, 3), 0.02, np.float32)
    quiet, noisy = (
        expose(dark, Sensor((1.0, 1.0, 1.0), replace(CLEAN, read_noise=share)), np.random.default_rng(1)).astype(float)
        for share in (0.0, 0.004)
    )
    assert quiet.std(axis=(0, 1)).max() == 0.0
    assert noisy.std() > 2.0


def test_jpeg_costs_little_at_its_quality_and_more_below() -> None:
    rng = np.random.default_rng(4)
    rows, columns = np.mgrid[:64, :96]
    picture = np.stack([rows + columns, 2 * rows, 200 - columns], axis=2).clip(0, 255).astype(np.uint8)
    picture = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
    off = [np.abs(compress_jpeg(picture, quality).astype(int) - picture).mean() for quality in (92, 40)]
    assert 0.0 < off[0] < 2.5 < off[1] + 1.0
    assert off[0] < off[1]
