"""Shapes of a mesh together: a mouth that closes after it has opened, and visemes."""

import numpy as np

from pipeline.applications.templates.animated import parted_shapes
from pipeline.applications.templates.contact import crossings, rest_surface
from pipeline.head_model.visemes import VISEMES, mixed
from tests.pipeline.applications.templates.test_contact import EVERY, dent, sheets


def test_a_mouth_closes_after_it_has_opened_and_speaks_without_crossing() -> None:
    vertices, faces = sheets(gap_mm=0.3)
    rest, upper = rest_surface(vertices, faces), np.arange(len(vertices)) >= len(vertices) // 2
    opening = np.where(upper, 0.0, -8.0)[:, None] * (0.0, 0.0, 1.0)
    closing = -opening + dent(vertices, 1.5)
    shapes = {"jawOpen": opening, "mouthClose": closing, "mouthFunnel": dent(vertices, 2.0)}
    assert crossings(rest, opening + closing).sum() > 0
    found = parted_shapes(rest, shapes)
    assert list(found) == [*shapes, *VISEMES]
    np.testing.assert_array_equal(found["jawOpen"], opening)
    assert crossings(rest, found["jawOpen"] + found["mouthClose"], EVERY).sum() == 0
    for name in VISEMES:
        assert crossings(rest, found[name], EVERY).sum() == 0, name
    np.testing.assert_allclose(found["viseme_aa"], mixed(found, VISEMES["viseme_aa"]))
    assert not found["viseme_sil"].any()
