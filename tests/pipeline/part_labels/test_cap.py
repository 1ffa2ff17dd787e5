"""A painted ball wears a cap: it is found by a name or a near colour, in light and in shadow, and nothing else is."""

import numpy as np
import pytest

from pipeline.contour_fit.bare_outline import shrink_cap_outlines
from pipeline.detail.dense_points import SurfacePoints, skin_under_cap
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.part_labels.appearance_cells import Cells
from pipeline.part_labels.cap import Cap, cap_cells, colour_of
from pipeline.part_labels.codes import Part
from rig.colour_space import linear_from_srgb, srgb_from_text
from rig.rig import Rig
from tests.pipeline.part_labels.test_votes import DISTANCE_MM, FOCAL, SIZE, seen_wall, wall_camera

Colour = tuple[float, float, float]
SKIN, BLUE, BLACK, WHITE = (0.45, 0.28, 0.2), (0.02, 0.1, 0.42), (0.02, 0.02, 0.022), (0.7, 0.68, 0.64)
BROWN_HAIR = (0.09, 0.05, 0.025)
ROWS, RADIUS, BROWS_MM = 120, 50.0, 70.0  # cells of a millimetre; heights above the chin


def ball(cap: Colour, shirt: Colour = SKIN) -> Cells:
    """A ball of skin, lit from one side, with a cap on its upper third, a highlight on that, and a shirt below."""
    row, column = np.indices((ROWS, ROWS))
    across, up = (column - ROWS / 2) / RADIUS, (ROWS / 2 - row) / RADIUS
    on_head = np.hypot(across, up) < 1.0
    worn = on_head & (up > 0.3)
    light = 1.2 - 0.9 * (across + 1.0) / 2.0  # a quarter on the far side
    linear = np.where(worn[..., None], cap, SKIN) * light[..., None]
    below = up < -0.95
    linear[below] = shirt
    linear[np.hypot(across - 0.1, up - 0.6) < 0.08] += 0.25  # silicone shines
    blank, shape = np.zeros((ROWS, ROWS), np.float32), (ROWS, ROWS)
    return Cells(
        camera=wall_camera("a", 0.0),
        size_px=1,
        colour=np.array([colour_of(each) for each in linear.reshape(-1, 3)], np.float32).reshape(*shape, 3),
        detail=blank,
        grey=blank,
        inside=(on_head | below).astype(np.float32),
        on_head=on_head,
        into_face_mm=blank,
        above_chin_mm=(RADIUS * up + RADIUS).astype(np.float32),
        cheek=(np.hypot(across, up + 0.3) < 0.2).astype(np.float32),
        feature=blank,
        underside=blank,
        outside_mm=blank,
    )


def stated(name: str) -> np.ndarray:
    srgb = srgb_from_text(name)
    assert srgb is not None
    return colour_of(linear_from_srgb(np.array(srgb)))


@pytest.mark.parametrize(
    ("worn", "name"),
    [(BLUE, "blue"), (BLUE, "navy"), (BLUE, "#2458ac"), (BLACK, "black"), (WHITE, "white"), (WHITE, "grey")],
)
def test_a_cap_is_found_by_its_colour(worn, name):
    view = ball(worn)
    pieces, share = cap_cells([view], BROWS_MM - 20.0, stated(name))
    assert share > 0.95
    row = np.indices((ROWS, ROWS))[0]
    true = view.on_head & ((ROWS / 2 - row) / RADIUS > 0.3)
    assert (pieces["a"] ^ true).sum() < 0.02 * true.sum()  # the highlight is filled


@pytest.mark.parametrize(("worn", "name"), [(BLUE, "red"), (BLUE, "white"), (BROWN_HAIR, "black"), (SKIN, "orange")])
def test_no_cap_is_found_where_none_of_its_colour_is(worn, name):
    assert cap_cells([ball(worn)], BROWS_MM - 20.0, stated(name))[0] == {}


def test_a_shirt_of_the_same_colour_is_no_cap():
    pieces, _ = cap_cells([ball(BLUE, shirt=BLUE)], BROWS_MM - 20.0, stated("blue"))
    assert not pieces["a"][ROWS // 2 + 20 :].any()


def test_colours_are_read_from_names_and_codes():
    assert srgb_from_text("Blue") == (0.0, 0.0, 1.0)
    assert srgb_from_text("#ff8000") == pytest.approx((1.0, 128 / 255, 0.0))
    assert [srgb_from_text(wrong) for wrong in ("mauve-ish", "#ff80", "ff8000", "")] == [None] * 4


def test_an_outline_moves_inwards_by_the_thickness_along_the_cap_alone():
    camera = wall_camera("a", 0.0)
    row, column = np.indices((SIZE, SIZE)) - SIZE // 2
    seen = silhouette_from_mask(np.hypot(row, column) < 22)
    worn = Cap({"a": seen.mask & (row < -4)}, thickness_mm=2.0, share=1.0)
    bare = shrink_cap_outlines({"a": seen}, worn, Rig((camera,)), np.zeros(3))
    moved = bare.silhouettes["a"].distance - seen.distance
    at_top, at_bottom = (SIZE // 2 - 22, SIZE // 2), (SIZE // 2 + 21, SIZE // 2)
    assert moved[at_top] == pytest.approx(2.0 * FOCAL / DISTANCE_MM)
    assert moved[at_bottom] == 0.0
    assert bare.silhouettes["a"].mask.sum() < seen.mask.sum()


def test_points_on_a_cap_become_skin_below_it():
    rig = Rig((wall_camera("a", 0.0), wall_camera("b", 6.0)))
    left = np.zeros((SIZE, SIZE), bool)
    left[:, : SIZE // 2] = True
    points = SurfacePoints(
        np.array([[-20.0, 0.0, 0.0], [20.0, 0.0, 0.0], [-20.0, 8.0, 0.0]]),
        np.tile([0.0, 0.0, -1.0], (3, 1)),
        np.full(3, 0.4),
        np.array([Part.CLOTHES, Part.CLOTHES, Part.SKIN], np.uint8),
    )
    found = skin_under_cap(points, [seen_wall(each) for each in rig], Cap({"a": left, "b": left}, 1.5, 1.0), rig)
    assert found.part.tolist() == [Part.SKIN, Part.CLOTHES, Part.SKIN]
    np.testing.assert_allclose(found.points[:, 2], [1.5, 0.0, 0.0])
    np.testing.assert_allclose(found.deviation_mm, [0.5, 0.4, 0.4])
