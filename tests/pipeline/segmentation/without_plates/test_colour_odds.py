"""Two cloths with known colours."""

import numpy as np

from pipeline.segmentation.without_plates.mask_search import Samples, colour_odds, histogram

NOISE = np.full(3, 3.0)


def cloths(left: tuple[int, ...], right: tuple[int, ...], shade: float = 0.0) -> np.ndarray:
    """The left half in one colour, the right half in another, darker by ``shade`` towards the lower border."""
    rng = np.random.default_rng(0)
    image = np.zeros((60, 80, 3), np.float32)
    image[:, :40], image[:, 40:] = left, right
    image *= np.linspace(1, 1 - shade, 60, dtype=np.float32)[:, None, None]
    return (image + rng.normal(0, 3, image.shape)).astype(np.float32)


def sampled() -> Samples:
    subject, background = np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    subject[10:50, 5:30], background[10:50, 50:75] = True, True
    return Samples(subject, background)


def test_colours_that_differ_are_told_apart_everywhere_and_one_that_was_never_seen_is_neither() -> None:
    image, samples = cloths((180, 130, 110), (60, 90, 140)), sampled()
    image[:5, :5] = (20, 220, 30)
    odds = colour_odds(image, samples, histogram(image[samples.subject]), NOISE, nearby=False)
    assert (odds[5:, :40] > 1).mean() > 0.95
    assert (odds[:, 40:] < -1).mean() > 0.95
    assert np.abs(odds[1:4, 1:4]).max() < 0.5


def test_colours_nearby_tell_what_the_whole_images_do_not() -> None:
    """Light falls off by half: the subject's lower colour is the background's upper one."""
    image, samples = cloths((150, 150, 150), (110, 110, 110), shade=0.5), sampled()
    common = histogram(image[samples.subject])
    right = {}
    for nearby in (False, True):
        odds = colour_odds(image, samples, common, NOISE, nearby=nearby)
        right[nearby] = 0.5 * ((odds[10:50, 5:30] > 0).mean() + (odds[10:50, 50:75] < 0).mean())
    assert right[True] > 0.97
    assert right[True] > right[False]
