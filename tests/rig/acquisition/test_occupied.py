"""Somebody in the empty studio, against light that changed, noise, and a studio that was rebuilt."""

import numpy as np
import pytest

from rig.acquisition.occupied import ImageRgb, occupied

NAMES = ("cam00", "cam01", "cam02")


def studio(seed: int) -> dict[str, ImageRgb]:
    """Uneven grey backdrops with texture, each camera another."""
    found = {}
    for i, name in enumerate(NAMES):
        rng = np.random.default_rng([seed, i])
        coarse = rng.uniform(60, 150, (12, 16, 3))
        found[name] = np.repeat(np.repeat(coarse, 20, axis=0), 20, axis=1).astype(np.uint8)
    return found


def noisy(pictures: dict[str, ImageRgb], gain: float = 1.0) -> dict[str, ImageRgb]:
    rng = np.random.default_rng(9)
    return {
        name: np.clip(gain * image + 2.0 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)
        for name, image in pictures.items()
    }


def seated(pictures: dict[str, ImageRgb], names: tuple[str, ...] = NAMES) -> dict[str, ImageRgb]:
    """With a dark ellipse of a tenth of the picture."""
    found = {name: image.copy() for name, image in pictures.items()}
    y, x = np.mgrid[:240, :320]
    for name in names:
        found[name][((x - 150) / 42) ** 2 + ((y - 130) / 58) ** 2 < 1] = (40, 30, 25)
    return found


def test_one_who_sits_there_is_seen_by_all_cameras_under_other_light_and_noise() -> None:
    assert occupied(noisy(seated(studio(0)), gain=0.8), studio(0)) == NAMES


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.3])
def test_light_and_noise_are_nobody(gain: float) -> None:
    assert occupied(noisy(studio(0), gain), studio(0)) == ()


def test_what_one_camera_alone_sees_is_nobody() -> None:
    """A camera whose view was blocked, or that was moved, has faults of its own."""
    assert occupied(seated(studio(0), NAMES[:1]), studio(0)) == ()


def test_a_studio_that_was_rebuilt_is_not_occupied() -> None:
    assert occupied(studio(1), studio(0)) == ()


def test_without_plates_before_or_of_another_size_nothing_is_said() -> None:
    assert occupied(seated(studio(0)), {}) == ()
    assert occupied({name: image[::2, ::2] for name, image in seated(studio(0)).items()}, studio(0)) == ()
