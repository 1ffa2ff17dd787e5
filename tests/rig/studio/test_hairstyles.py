"""Hair by name: each style changes what it says, hides what it should, and leaves the seed's other draws alone."""

from dataclasses import replace

import numpy as np
import pytest

from rig.errors import InputError
from rig.mesh import Mesh, face_normals, vertex_normals
from rig.render.renderer import Renderer
from rig.studio.scene.anatomy import Anatomy, anatomy, finer_grid
from rig.studio.scene.hair import HairStyle, add_curls, beard_share, grow, make_bun, make_hanging_hair
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.scene.subject import HAIRSTYLES, Look, Subject, dress, restyle
from rig.studio.scene.worn import make_cap, make_glasses
from tests.rig.studio.test_images import egg_head
from tests.support.small_studio import CLEAN

CALM = HairStyle(thickness_mm=10.0, over_ears=True, lumps=0.0, strands=0)


@pytest.fixture(scope="module")
def head() -> Mesh:
    return egg_head().mesh


@pytest.fixture(scope="module")
def body(head) -> Anatomy:
    return anatomy(head.vertices, egg_head().landmarks)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def plain_look() -> Look:
    return Look((0.4, 0.3, 0.2), (0.1, 0.1, 0.1), HairStyle())


def test_finer_grid_keeps_its_vertices_and_closes():
    field = np.random.default_rng(1).normal(size=(7, 12, 3))
    fine = finer_grid(field, 3)
    assert fine.shape == (19, 36, 3)
    np.testing.assert_allclose(fine[::3, ::3], field)
    np.testing.assert_allclose(fine[0, 35], (field[0, 11] + 2 * field[0, 0]) / 3)


def test_no_curls_where_their_amount_is_zero():
    points = np.random.default_rng(2).uniform(-100, 100, (4000, 3))
    normals = np.tile((0.0, 0.0, 1.0), (4000, 1))
    amount = (points[:, 0] > 0).astype(float)
    moved, shade = add_curls(points, normals, 8.0, amount, rng())
    np.testing.assert_array_equal(moved[amount == 0], points[amount == 0])
    np.testing.assert_array_equal(shade[amount == 0], 1.0)
    assert 1.0 < (moved - points)[amount > 0, 2].std() < 8.0
    assert shade.min() > 0.3


def test_curls_stay_about_the_smooth_hair(head, body):
    smooth = grow(head.vertices, body, CALM, rng())
    curly = grow(head.vertices, body, replace(CALM, curl_mm=9.0), rng())
    assert len(curly.shell) > 3.9 * len(smooth.shell)  # fine enough to show them
    high = [shell.shell[shell.shell[:, 1] > body.ears[1] + 60] - body.ears for shell in (smooth, curly)]
    mean, rough = np.linalg.norm(high[0], axis=1).mean(), np.linalg.norm(high[1], axis=1).mean()
    assert abs(mean - rough) < 6.0


def test_long_hair_ends_where_it_should_and_outside_the_neck(head, body):
    style = replace(CALM, hanging_mm=120.0)
    scalp = grow(head.vertices, body, style, rng())
    sheet = make_hanging_hair(scalp, head.vertices, body, style, rng())
    lowest = sheet.shell[:, 1].min()
    assert abs(body.ears[1] - 120.0 * body.unit - lowest) < 30.0  # ends are ragged by 7 mm, standard deviation
    behind = np.abs(sheet.shell[:, 0]) < 20
    assert sheet.shell[behind, 2].max() < body.ears[2]
    neck = head.vertices[np.abs(head.vertices[:, 1] - (body.ears[1] - 90)) < 6]
    level = sheet.shell[behind & (np.abs(sheet.shell[:, 1] - (body.ears[1] - 90)) < 6)]
    assert level[:, 2].max() < neck[:, 2].min()


def test_long_hair_rests_on_the_shoulders(head, body):
    style = replace(CALM, hanging_mm=170.0)
    turn, drop = np.meshgrid(np.linspace(0, 2 * np.pi, 400), np.linspace(130, 200, 60))
    reach = 60 + 0.8 * (drop - 130)
    worn = body.ears + np.stack([reach * np.sin(turn), -drop, reach * np.cos(turn)], axis=-1).reshape(-1, 3)
    scalp = grow(head.vertices, body, style, rng())
    free = make_hanging_hair(scalp, head.vertices, body, style, rng())
    resting = make_hanging_hair(scalp, np.concatenate([head.vertices, worn]), body, style, rng())
    low = free.shell[:, 1] < body.ears[1] - 160 * body.unit
    radius = [np.hypot(*(hair.shell[low] - body.ears)[:, [0, 2]].T) for hair in (free, resting)]
    assert np.median(radius[1] - radius[0]) > 4.0


def test_bun_sits_on_the_crown(head, body):
    style = replace(CALM, bun_mm=30.0)
    scalp = grow(head.vertices, body, style, rng())
    bun = make_bun(scalp, body, style, rng())
    assert bun.shell[:, 1].max() > scalp.shell[:, 1].max() + 5.0
    assert np.ptp(bun.shell[:, 0]) == pytest.approx(60.0, rel=0.2)
    outward = (vertex_normals(bun.shell, bun.shell_faces) * (bun.shell - bun.shell.mean(axis=0))).sum(axis=1)
    assert (outward > 0).mean() > 0.9


def test_beard_leaves_lips_cheeks_and_forehead_free(head, body):
    marks = body.landmarks
    points = np.array([marks["gnathion"], marks["labiale_superius"], marks["stomion"], marks["glabella"],
                       marks["pronasale"], marks["exocanthion_left"]])  # fmt: skip
    share = beard_share(points, body)
    assert share[0] > 0.9
    np.testing.assert_allclose(share[1:], 0.0, atol=0.05)


def test_cap_covers_the_crown_and_shades_no_ear(head, body):
    style = replace(CALM, over_ears=False)
    scalp = grow(head.vertices, body, style, rng())
    vertices, _ = make_cap(head.vertices, scalp.shell, body)
    assert vertices[:, 1].max() > scalp.shell[:, 1].max()
    crown = scalp.shell[scalp.shell[:, 1] > body.ears[1] + 100 * body.unit]
    towards = (crown - body.ears) / np.linalg.norm(crown - body.ears, axis=1, keepdims=True)
    cloth = vertices - body.ears
    for direction, reach in zip(towards[::50], np.linalg.norm(crown - body.ears, axis=1)[::50], strict=True):
        near = cloth @ direction > 0.995 * np.linalg.norm(cloth, axis=1)
        assert np.linalg.norm(cloth[near], axis=1).max() > reach
    assert vertices[:, 1].min() > body.ears[1] - 15 * body.unit
    assert vertices[:, 2].max() > head.vertices[:, 2].max() + 20  # the visor


def test_glasses_stand_before_the_eyes_and_reach_the_ears(head, body):
    vertices, faces = make_glasses(head.vertices, body)
    eye = body.landmarks["exocanthion_left"]
    rim = vertices[np.hypot(vertices[:, 0] - eye[0], vertices[:, 1] - eye[1]) < 30]
    assert rim[:, 2].max() > eye[2]
    assert vertices[:, 2].min() < body.ears[2]
    assert np.linalg.norm(face_normals(vertices, faces), axis=1).max() > 0
    np.testing.assert_allclose(vertices[:, 0].max(), -vertices[:, 0].min(), atol=1.0)


@pytest.mark.parametrize("changes", [{"glasses": True}, {"beard": HairStyle()}])
def test_a_head_without_landmarks_says_that_it_can_wear_neither_glasses_nor_beard(renderer, changes):
    bare = Subject(egg_head().mesh)
    pose = simulate(bare, default_layout().subset(["cam00"]).scaled(0.1), CLEAN, rng(), renderer=renderer)
    with pytest.raises(InputError, match="landmarks"):
        dress(renderer, bare, replace(plain_look(), **changes), pose.scene.world_from_head, clothes=False, rng=rng())


def test_names_add_up_in_their_order_and_unknown_ones_are_refused():
    look = restyle(plain_look(), ["curly", "beard", "glasses"])
    assert look.hair is not None
    assert look.beard is not None
    assert look.hair.curl_mm > 0
    assert look.glasses
    assert restyle(look, ["bald"]).hair is None
    assert restyle(plain_look(), []) == plain_look()
    with pytest.raises(InputError, match=r"mohawk is not one of short, .*glasses"):
        restyle(plain_look(), ["long", "mohawk"])


def photographed(renderer: Renderer, *hairstyle: str) -> SimulatedCapture:
    rig = default_layout().subset(["cam00", "cam09"]).scaled(0.25)
    preset = replace(CLEAN, hair=True, clothes=True, hairstyle=hairstyle)
    return simulate(egg_head(), rig, preset, rng(), renderer=renderer)


@pytest.mark.gl
@pytest.mark.parametrize("name", sorted(HAIRSTYLES))
def test_every_style_can_be_photographed_on_the_same_subject(renderer, name):
    """Pose and clean plates stay the seed's own."""
    drawn, styled = photographed(renderer), photographed(renderer, name)
    for camera in drawn.capture.images:
        np.testing.assert_array_equal(drawn.capture.backgrounds[camera][0], styled.capture.backgrounds[camera][0])
        np.testing.assert_array_equal(drawn.scene.head_masks[camera], styled.scene.head_masks[camera])
        assert (drawn.capture.images[camera] != styled.capture.images[camera]).any()
        outside = styled.scene.head_masks[camera] & ~styled.masks[camera]
        assert outside.sum() <= 20  # nothing worn takes anything of the head away
