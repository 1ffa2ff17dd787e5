"""Light that skin mirrors: at its rim it is as grey as a wall, and some of it falls on the wall."""

import numpy as np

from pipeline.segmentation.background import ANY_COLOUR_ODDS
from pipeline.segmentation.foreground import find_shadows
from pipeline.segmentation.mask_kernels import solve_alpha
from pipeline.segmentation.matting import COARSE_ALPHA_SIGMA, LINEAR, SHADE

WALL, SKIN = (103, 103, 105), (221, 180, 165)
NOISE = 1.5  # levels
BAND = 1  # the zone along the outline


def alpha_of(colours: list[tuple[int, int, int]]) -> np.ndarray:
    """The alpha of one pixel of each colour, by the subject's colour next to it."""
    count = len(colours)
    image = np.array([colours, colours], np.uint8)
    plate = np.full((1, 2, count, 3), WALL, np.uint8)
    ones, cells = np.ones((2, count, 3), np.float32), (2, count)
    subject = np.broadcast_to(np.array(SKIN, np.float32), (2, count, 3)).copy()
    sigma, zone, prior = np.full(cells, NOISE, np.float32), np.full(cells, BAND, np.uint8), np.full(cells, 0.6)
    widths = (COARSE_ALPHA_SIGMA, SHADE)
    return solve_alpha(LINEAR, image, plate, ones, sigma, zone, prior.astype(np.float32), subject, widths, False)[0][0]


def test_a_highlight_at_the_rim_is_subject() -> None:
    # Pixels of an oily nose before a grey wall, from its outline inwards.
    assert (alpha_of([(255, 235, 239), (245, 243, 231), (244, 241, 226), (251, 238, 222)]) > 0.7).all()


def test_skin_that_darkens_towards_its_rim_and_its_mixtures_keep_their_alpha() -> None:
    skin, wall = (LINEAR[list(colour)] for colour in (SKIN, WALL))
    for true in (0.0, 0.25, 0.5, 0.75, 1.0):
        for shade in (0.92, 1.0, 1.08):
            codes = np.rint(np.interp(true * shade * skin + (1.0 - true) * wall, LINEAR, np.arange(257)))
            # A brightness off by its standard deviation moves alpha by 0.06.
            assert abs(alpha_of([tuple(codes.astype(int))] * 2)[0] - true) < 0.07


def test_faint_light_that_begins_softly_is_wall_and_a_lighter_coat_with_a_sharp_edge_is_not() -> None:
    plate = np.full((60, 80, 3), 120.0, np.float32)
    row = np.arange(60.0)[:, None]
    light = 0.06 * np.exp(-0.5 * ((row - 30.0) / 7.0) ** 2)  # as soft as a shadow
    lit, coat = (plate * (1.0 + light[:, :, None])).astype(np.float32), plate.copy()
    coat[20:, 20:60] *= 1.06
    variance = np.full((60, 80, 3), 1.0, np.float32)
    for image, is_wall in ((lit, True), (coat, False)):
        chi2 = ((image - plate) ** 2 / variance).sum(axis=2)
        odds = 0.5 * chi2 - ANY_COLOUR_ODDS
        assert (odds > 0).any()
        left, backdrop = find_shadows(image, plate, chi2, variance, odds)
        assert backdrop[odds > 0].all() == backdrop.any() == is_wall
        assert (left[30, 40] < 1.0) == is_wall
