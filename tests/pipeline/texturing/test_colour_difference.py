"""CIEDE2000 against the pairs that were published to find mistakes with."""

import numpy as np
import pytest

from tests.support.colour_difference import difference_2000, lab_from_srgb

# Sharma, Wu and Dalal (2005), table 1: two colours and their difference.
PAIRS = """
50 2.6772 -79.7751 50 0 -82.7485 2.0425
50 -1.3802 -84.2814 50 0 -82.7485 1.0000
50 0 0 50 -1 2 2.3669
50 2.4900 -0.0010 50 -2.4900 0.0009 7.1792
50 2.4900 -0.0010 50 -2.4900 0.0010 7.1792
50 2.4900 -0.0010 50 -2.4900 0.0011 7.2195
50 2.4900 -0.0010 50 -2.4900 0.0012 7.2195
50 -0.0010 2.4900 50 0.0009 -2.4900 4.8045
50 -0.0010 2.4900 50 0.0010 -2.4900 4.8045
50 -0.0010 2.4900 50 0.0011 -2.4900 4.7461
50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492
50 2.5 0 56 -27 -3 31.9030
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
"""


def test_the_published_pairs() -> None:
    table = np.array([line.split() for line in PAIRS.split("\n") if line], float)
    assert len(table) == 16
    np.testing.assert_allclose(difference_2000(table[:, :3], table[:, 3:6]), table[:, 6], atol=6e-5)
    np.testing.assert_allclose(difference_2000(table[:, 3:6], table[:, :3]), table[:, 6], atol=6e-5)


def test_srgb_in_lab() -> None:
    """Lindbloom's values of sRGB's white, red and grey, D65."""
    codes = np.array([[255, 255, 255], [255, 0, 0], [119, 119, 119]], np.uint8)
    found = lab_from_srgb(codes)
    assert found[0] == pytest.approx([100, 0, 0], abs=0.1)
    assert found[1] == pytest.approx([53.24, 80.09, 67.20], abs=0.15)
    assert found[2] == pytest.approx([50.03, 0, 0], abs=0.1)
