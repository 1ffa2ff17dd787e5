"""Colours against a pattern that is a formula, photographed by a ray tracer that shares no code with the pipeline;
labels and seams against enumeration; levelling against a sparse solver."""

from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from pipeline.geometry.projection import depth_map, depth_maps
from pipeline.head_model.subdivision import boundary_loops, close_loop
from pipeline.imaging.colour_balance import balance
from pipeline.imaging.silhouette import ViewQuality, silhouette_from_mask
from pipeline.settings import TextureSettings
from pipeline.texturing.layout.uv_unwrap import unwrap
from pipeline.texturing.neighbourhood import LEVELLING, Neighbourhood, fill_unknown, level_views, neighbours
from pipeline.texturing.paint import paint_texture
from pipeline.texturing.vertex_colours import (
    MIN_LIKENESS,
    Texture,
    add_similar_views,
    colour_vertices,
    fill_unobserved_patches,
    find_unlike,
    select_views,
    wide_doubtful_surface,
)
from pipeline.texturing.view_selection_kernels import OUTLIER, RING_SHARE, differences, fill_slots
from pipeline.texturing.visibility import see_weights, sharpen
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.mesh import Mesh
from rig.studio.scene.anatomy import grid_faces
from tests.support.photographs import SCREEN, Shot, shoot
from tests.support.scenes import ellipsoid, fan, pattern

EXPOSURES = np.array([0.8, 1.2, 0.9, 1.1, 1.2, 0.8, 1.0])[:, None] * np.array([1.0, 0.98, 1.03])


def colour(shot: Shot, outlier: float = OUTLIER, **settings) -> Texture:
    made, depths = TextureSettings(**settings), depth_maps(shot.rig, shot.mesh)
    return colour_vertices(shot.mesh, shot.capture, shot.silhouettes, shot.rig, depths, settings=made, outlier=outlier)


def psnr(found: Texture, shot: Shot, where: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / ((found.colours[where] - shot.truth[where]) ** 2).mean()))


@pytest.fixture(scope="module")
def even() -> Shot:
    return shoot()


@pytest.fixture(scope="module")
def uneven() -> Shot:
    return shoot(EXPOSURES)


@pytest.fixture(scope="module")
def even_colours(even: Shot) -> Texture:
    return colour(even)


@pytest.fixture(scope="module")
def uneven_colours(uneven: Shot) -> Texture:
    return colour(uneven)


def test_the_default_is_better_than_the_papers_mean_by_far_where_exposures_differ(
    even: Shot, even_colours: Texture, uneven: Shot, uneven_colours: Texture
) -> None:
    for shot, found, better in ((uneven, uneven_colours, 3.0), (even, even_colours, 0.0)):
        reference = colour(shot, blend="reference")
        visible = (found.views > 0) & (reference.views > 0)
        assert visible.mean() > 0.6
        assert psnr(found, shot, visible) > psnr(reference, shot, visible) + better
    # 1.5 % noise is 3.8 codes; some three views and four pixels each leave 3.8 / sqrt(3) / 1.5 = 1.5 codes: 44 dB.
    assert psnr(even_colours, even, even_colours.views > 0) > 38


def test_gains_are_found(uneven_colours: Texture) -> None:
    found = np.array(list(uneven_colours.gains.values()))
    wanted = 1 / EXPOSURES
    wanted /= np.exp(np.log(wanted).mean(axis=0))
    np.testing.assert_allclose(found, wanted, rtol=0.015)


def test_no_background_reaches_the_mesh(even: Shot, even_colours: Texture) -> None:
    found = even_colours
    screen = 255 * srgb_from_linear(np.array(SCREEN))
    # On the way from the truth to the screen's green: how far, as a share?
    way = screen - even.truth
    share = ((found.colours - even.truth) * way).sum(axis=1) / (way * way).sum(axis=1)
    assert share[found.views > 0].max() < 0.1


def test_hidden_surfaces_take_no_colour_from_what_hides_them() -> None:
    # A red plate stands between the camera in the middle and the ellipsoid: what is behind it must stay blue.
    rig = fan(640, 480, (0,))
    camera, body = rig.cameras[0], ellipsoid(4)
    towards = camera.centre_world / np.linalg.norm(camera.centre_world)
    right = np.cross([0.0, 1.0, 0.0], towards)
    up = np.cross(towards, right)
    steps = np.linspace(-25, 25, 26)
    plate = np.stack([170 * towards + x * right + y * up for y in steps for x in steps])
    count = len(body.vertices)
    faces = np.concatenate([body.faces, count + grid_faces(26, 26, closed=False)[:, ::-1]])
    mesh = Mesh(np.concatenate([body.vertices, plate]), faces.astype(np.int32))
    depth, seen = depth_map(camera, mesh.vertices, mesh.faces)
    linear = np.where((seen >= len(body.faces))[:, :, None], (0.8, 0.05, 0.05), (0.05, 0.1, 0.6))
    image = np.rint(255 * srgb_from_linear(np.where(np.isfinite(depth)[:, :, None], linear, 0.3))).astype(np.uint8)
    silhouette = silhouette_from_mask(np.isfinite(depth))
    capture = Capture({"cam00": image})
    found = colour_vertices(mesh, capture, {"cam00": silhouette}, rig, {"cam00": depth}, settings=TextureSettings())
    lit = found.views[:count] > 0
    assert lit.sum() > 500
    assert (found.colours[:count][lit][:, 0] < 80).all()
    pixels = camera.project(mesh.vertices)
    behind = depth[np.rint(pixels[:count, 1]).astype(int), np.rint(pixels[:count, 0]).astype(int)] < 1080
    assert (found.views[:count][behind] == 0).all()


def test_highlights_count_less_than_what_the_other_views_say() -> None:
    shot = shoot(gloss=0.5)
    robust, plain = colour(shot), colour(shot, outlier=1e6)
    visible = robust.views >= 3
    assert psnr(robust, shot, visible) > psnr(plain, shot, visible) + 0.5


def test_a_view_that_is_not_usable_gives_no_colour_and_a_head_without_any_is_grey_and_says_so(even: Shot) -> None:
    bad = {name: replace(s, quality=ViewQuality(usable=name != "cam03")) for name, s in even.silhouettes.items()}
    images = {**even.capture.images, "cam03": np.zeros_like(even.capture.images["cam03"])}
    found = colour(replace(even, silhouettes=bad, capture=replace(even.capture, images=images)))
    assert "cam03" not in found.gains
    assert psnr(found, even, found.views > 0) > 36
    bad = {name: replace(s, quality=ViewQuality(usable=False)) for name, s in even.silhouettes.items()}
    found = colour(replace(even, silhouettes=bad))
    assert (found.views == 0).all()
    assert not found.views.any()
    assert found.warnings[0].code == "no-texture"
    assert (np.ptp(found.colours, axis=0) == 0).all()


def test_strongly_different_exposures_are_named_in_one_sentence() -> None:
    one, many = np.ones((7, 3)), np.ones((7, 3))
    one[2], many[1:6] = 0.4, np.array([0.4, 2.5, 0.45, 2.2, 0.4])[:, None]
    (alone,), (together,) = (colour(shoot(gains)).warnings for gains in (one, many))
    assert (alone.code, together.code) == ("camera-gain", "cameras-uneven")
    assert "cam02" in alone.text
    assert int(str(together.parameters["count"])) >= 4


def test_sharpening_takes_back_blur_where_there_is_detail_and_lifts_no_noise() -> None:
    rng = np.random.default_rng(5)
    truth = np.full((240, 320, 3), 120.0)
    truth[:, :160][:, ::16] = truth[:, 1:160][:, ::16] = 40.0  # two dark pixels in sixteen, like lashes
    blurred = cv2.GaussianBlur(truth, (0, 0), 0.7) + rng.normal(0, 3, truth.shape)
    image = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
    found = sharpen(image, np.ones((240, 320), bool), 1.0).astype(float)
    lines, flat = np.s_[10:-10, 10:150], np.s_[10:-10, 180:-10]
    before, after = (np.abs(picture[lines] - truth[lines]).mean() for picture in (image, found))
    assert after < 0.8 * before
    # Twice the median of the noise's own power is held back, so that only its largest bursts are lifted.
    assert found[flat].std() < 1.1 * image[flat].std()


def test_balance_finds_planted_gains_and_offsets() -> None:
    rng = np.random.default_rng(2)
    truth = rng.uniform(0.05, 0.6, (4000, 3))
    gains = np.exp(rng.normal(0, 0.2, (6, 3)))
    offsets = rng.normal(0, 0.003, (6, 3))
    seen = (truth - offsets[:, None]) / gains[:, None] + rng.normal(0, 0.002, (6, 4000, 3))
    weights = (rng.random((6, 4000)) < 0.5).astype(np.float32)
    found, shift = balance(weights, seen.astype(np.float32))
    level = np.exp(np.log(gains).mean(axis=0))
    # The prior holds half of an offset back: 0.0015 of 0.3 is half a percent, 1.5 % at three standard deviations.
    np.testing.assert_allclose(found, gains / level, rtol=0.02)
    assert np.abs(found[:, None] * seen + shift[:, None] - truth / level).max() < 0.03


def test_the_fill_solves_laplaces_equation_on_the_mesh() -> None:
    mesh = ellipsoid(3)
    rng = np.random.default_rng(0)
    known = mesh.vertices[:, 2] > 20
    values = rng.uniform(0, 1, (len(known), 2))
    found = fill_unknown(values, known, mesh.faces)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    graph = scipy.sparse.coo_array((np.ones(len(edges)), edges.T), shape=(len(known),) * 2)
    graph = (graph + graph.T).tocsr()
    laplacian = (scipy.sparse.diags_array(graph.sum(axis=1)) - graph).tocsr()
    unknown = np.flatnonzero(~known)
    right = -(laplacian[unknown][:, np.flatnonzero(known)] @ values[known])
    solved = scipy.sparse.linalg.spsolve(laplacian[unknown][:, unknown].tocsc(), right)
    np.testing.assert_array_equal(found[known], values[known])
    assert np.abs(found[unknown] - solved).max() < 0.02


def test_a_part_that_nobody_sees_is_filled_from_its_like() -> None:
    """Ears and a white wall coloured the back of heads before three cameras, whose hair is seen in front."""
    mesh = ellipsoid(5)
    front, upper = mesh.vertices[:, 2] > 0, mesh.vertices[:, 1] > 0
    values = np.where(upper, 1.0, 0.0)[:, None] * np.ones(3)
    found = fill_unknown(values, front, mesh.faces, upper.astype(np.uint8))
    np.testing.assert_array_equal(found[front], values[front])
    far = np.abs(mesh.vertices[:, 1]) > 0.5 * mesh.vertices[:, 1].max()
    assert np.abs(found - values)[far].max() < 1e-6
    assert 0.1 < np.abs(found - values)[~front & ~far].max() <= 0.6  # no straight cut between the two


OPENING_MM = 12.0


def with_strip(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """The ellipsoid, open below, with a flat strip across an opening in its front; and which faces are the strip's."""
    tip = mesh.vertices[mesh.vertices[:, 2].argmax()]
    off = np.linalg.norm(mesh.vertices - tip, axis=1)
    above = mesh.vertices[mesh.faces][:, :, 1].min(axis=1) > 0.8 * mesh.vertices[:, 1].min()
    kept = above & (off[mesh.faces] > OPENING_MM).any(axis=1)
    used, joined = np.unique(mesh.faces[kept], return_inverse=True)
    vertices, faces = mesh.vertices[used], joined.reshape(-1, 3).astype(np.int32)
    (loop,) = (loop for loop in boundary_loops(faces) if vertices[loop, 2].min() > 0.5 * tip[2])
    strip = close_loop(vertices, loop)
    whole = np.concatenate([faces, strip]).astype(np.int32)
    return Mesh(vertices, whole), np.arange(len(faces), len(whole))


def test_a_strip_across_an_opening_takes_one_photograph() -> None:
    shot = shoot()
    mesh, strip = with_strip(ellipsoid(5))
    settings, depths = TextureSettings(), depth_maps(shot.rig, mesh)
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    found = colour_vertices(mesh, shot.capture, shot.silhouettes, shot.rig, depths, settings=settings, around=around)
    assert found.decision is not None
    rim = np.unique(mesh.faces[strip])  # hidden by lids, as it were
    weights, slots, shares = (
        array.copy() for array in (found.decision.weights, found.decision.slots, found.decision.shares)
    )
    weights[:, rim], slots[rim], shares[rim] = 0.0, -1, 0.0
    hidden = replace(found.decision, weights=weights, slots=slots, shares=shares)
    skin = found.colours.copy()
    skin[rim] = (150, 110, 90)
    layout = unwrap(mesh.vertices, mesh.faces)
    unseen = np.asarray(found.decision.weights.max(axis=0) == 0)  # the back, which is filled
    seen = fill_unobserved_patches(hidden, mesh, shot.silhouettes, depths, unseen)
    assert len(np.unique(seen.slots[rim, 0])) == 1  # no seams in it
    assert fill_unobserved_patches(hidden, mesh, shot.silhouettes, depths, np.ones(len(skin), bool)) is hidden
    others = np.setdiff1d(np.arange(len(mesh.vertices)), rim)
    np.testing.assert_array_equal(seen.slots[others], hidden.slots[others])
    truth = 255 * srgb_from_linear(pattern(mesh.vertices[mesh.faces[strip]].mean(axis=1)))
    off = []
    for decision in (hidden, seen):
        image = np.ascontiguousarray(paint_texture(layout, mesh, skin, decision, 1024).image)
        middle = (1024 * layout.uv[layout.faces[strip]].mean(axis=1) - 0.5).astype(np.float32)
        shown = cv2.remap(image, middle[None, :, 0], middle[None, :, 1], cv2.INTER_LINEAR)[0]
        off.append(np.median(np.abs(shown - truth)))
    assert off[1] < 5 < 15 < off[0]


def test_the_edge_of_what_views_show_does_not_colour_the_back() -> None:
    """Before frontal cameras the wall that shines through the edge of hair made the back of a head grey."""
    shot = shoot()
    mesh, views = shot.mesh, shot.rig.subset(shot.rig.names[2:5])
    depths, normals = depth_maps(views, mesh), mesh.normals()
    seen = [see_weights(c, shot.silhouettes[c.name], depths[c.name], mesh.vertices, normals) for c in views]
    doubtful, shown = wide_doubtful_surface(np.stack(seen), mesh), np.max(seen, axis=0) > 0
    assert doubtful[~shown].mean() > 0.95
    assert 0.01 < (doubtful & shown).mean() < 0.1
    nostril = np.ones((1, len(shown)), np.float32)
    nostril[:, mesh.faces[:6]] = 0.0
    assert not wide_doubtful_surface(nostril, mesh).any()


def chain(count: int) -> Neighbourhood:
    """A path of vertices, each beside the next."""
    rows = [[w for w in (v - 1, v + 1) if 0 <= w < count] for v in range(count)]
    starts = np.cumsum([0] + [len(row) for row in rows]).astype(np.int32)
    return Neighbourhood.of(starts, np.concatenate(rows).astype(np.int32))


def strip(rows: int, columns: int) -> Neighbourhood:
    """A grid of triangles."""
    return Neighbourhood.of(*neighbours(grid_faces(rows, columns, closed=False).astype(np.int32), rows * columns))


def test_a_seam_keeps_out_of_where_views_differ() -> None:
    """The first view is better at the left end, the second at the right; between, all is alike but for one place."""
    rows, columns = 5, 30
    around = strip(rows, columns)
    x = np.tile(np.arange(columns) / (columns - 1), rows)
    weights = np.stack([1.0 - 0.4 * x, 0.6 + 0.4 * x]).astype(np.float32)
    codes = np.full((2, rows * columns, 3), 120.0, np.float32)
    middle = np.abs(x - 0.5) < 0.15  # where a seam would otherwise lie
    codes[0, middle] += 12
    codes[1, middle] -= 12
    agreed = np.full((rows * columns, 3), 120.0, np.float32)
    labels, _, _ = select_views(weights, codes, codes, agreed, np.ones((2, 3)), around=around)
    seam = labels[around.rows] != labels[around.indices]
    assert {*labels.tolist()} == {0, 1}
    assert not (middle[around.rows] & middle[around.indices] & seam).any()


def test_a_view_that_the_others_contradict_or_whose_camera_was_raised_much_is_not_chosen() -> None:
    around = strip(4, 6)
    weights = np.full((3, 24), 0.7, np.float32)
    weights[0] = 1.0  # would be the best
    codes = np.full((3, 24, 3), 100.0, np.float32)
    agreed = codes[0].copy()
    assert (select_views(weights, codes, codes, agreed, np.ones((3, 3)), around=around)[0] == 0).all()
    raised = np.array([[2.0] * 3, [0.7] * 3, [0.7] * 3])
    assert (select_views(weights, codes, codes, agreed, raised, around=around)[0] != 0).all()
    for off in (-25.0, 25.0):  # a shadow, a highlight
        codes[0] = 100.0 + off
        assert (select_views(weights, codes, codes, agreed, np.ones((3, 3)), around=around)[0] != 0).all()


Scene = tuple[Neighbourhood, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def random_scene(seed: int, count: int = 40, views: int = 7, noise: float = 0.06) -> Scene:
    """A chain of vertices that most views see, some of which disagree."""
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.05, 0.5, (views, count)) * (rng.random((views, count)) > 0.2)
    weights[0] = np.maximum(weights[0], 0.05)
    agreed = rng.uniform(20, 200, (count, 3))
    codes = agreed + rng.normal(0, noise, (views, count, 3)) * agreed * rng.choice([0.3, 1.5], (views, 1, 1))
    gains = 2.0 ** rng.normal(0, 0.2, (views, 3))
    weights, codes, agreed = (array.astype(np.float32) for array in (weights, codes, agreed))
    return chain(count), weights, codes, agreed, gains


def written_out(scene: Scene, levelled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cost, quality and disagreement of each view (v, k): what the best view sees better, a bounded share of
    disagreement, and raised cameras."""
    _, weights, codes, agreed, gains = scene
    views, count = weights.shape
    cost, quality, off = np.full((count, views), np.inf), np.zeros((count, views)), np.zeros((count, views))
    for v, k in np.argwhere(weights.T > 0):
        beside = [w for w in (v - 1, v + 1) if 0 <= w < count]
        least = min([weights[k, v], *weights[k, beside]])
        quality[v, k] = (1 - RING_SHARE) * weights[k, v] + RING_SHARE * least
        ordinary = 0.06 * agreed[v] + 2.0
        off[v, k] = max(np.sqrt(np.mean(((c[k, v] - agreed[v]) / ordinary) ** 2)) for c in (codes, levelled))
    for v, k in np.argwhere(weights.T > 0):
        square = off[v, k] ** 2
        raised = abs(np.log2(gains[k].mean()))
        cost[v, k] = 1 - quality[v, k] / quality[v].max() + 2.0 * square / (1 + square) + raised
    return cost, quality, off


@pytest.mark.parametrize("noise", [0.02, 0.06, 0.4])
@pytest.mark.parametrize("seed", range(4))
def test_seams_cost_more_where_views_differ(seed: int, noise: float) -> None:
    """The best of all labels of a short chain, seams included."""
    scene = random_scene(seed, 6, 3, noise)
    around, weights, codes, agreed, gains = scene
    labels, _, _ = select_views(weights, codes, codes, agreed, gains, around=around, seam_cost=0.3)
    cost, quality, off = written_out(scene, codes)
    unlike = np.minimum((quality * off).sum(axis=1) / quality.sum(axis=1), 3.0)
    seams = 0.3 * (0.3 + 0.5 * (unlike[:-1] + unlike[1:]))

    def total(chosen: tuple[int, ...]) -> float:
        return float(cost[np.arange(6), chosen].sum() + seams[np.diff(chosen) != 0].sum())

    best = min(product(range(3), repeat=6), key=total)
    assert total(tuple(labels.tolist())) == pytest.approx(total(best), abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_shares_fall_with_quality_and_with_what_is_more_than_noise(seed: int) -> None:
    around, weights, codes, agreed, gains = random_scene(seed)
    detail = (codes - agreed).astype(np.float32)
    labels, views, quality = select_views(weights, codes, codes, agreed, gains, around=around)
    labels[5] = -1
    off = differences(labels, views, detail, weights, around.starts, around.indices)
    others = [off[v, c] for v, c in np.ndindex(off.shape) if off[v, c] >= 0 and views[v, c] != labels[v]]
    noise = np.median(others)
    shares = np.zeros(off.shape, np.float32)
    for v, c in np.ndindex(off.shape):
        if off[v, c] >= 0 and labels[v] >= 0:
            past = max(off[v, c] / (4.0 * noise) - 1.0, 0.0)
            shares[v, c] = quality[v, c] / quality[v].max() * np.exp(-past)
    wanted = fill_slots(labels, views, shares, 4)
    found = add_similar_views(labels, views, quality, detail, weights, around=around)
    np.testing.assert_array_equal(found[0], wanted[0])
    np.testing.assert_allclose(found[1], wanted[1], rtol=1e-4)


def test_a_vertex_that_no_view_sees_has_no_label() -> None:
    around = strip(3, 4)
    weights = np.ones((2, 12), np.float32)
    weights[:, 5] = 0
    weights[0, :4] = 0
    codes = np.full((2, 12, 3), 90.0, np.float32)
    labels, views, _ = select_views(weights, codes, codes, codes[0], np.ones((2, 3)), around=around)
    assert (labels[5], views[5].tolist()) == (-1, [-1, -1])
    assert (labels[:4] == 1).all()


def test_views_are_averaged_where_they_differ_by_noise_alone() -> None:
    rng = np.random.default_rng(0)
    around, count = strip(20, 20), 400
    detail = rng.normal(0, 3, (3, count, 3)).astype(np.float32)
    eye = np.zeros(count, bool)
    eye[150:170] = True
    detail[0, eye] += rng.normal(0, 40, (20, 3))  # what lies a little elsewhere in the other views
    labels = np.zeros(count, np.int32)
    views = np.tile(np.array([0, 1, 2], np.int32), (count, 1))
    quality = np.ones((count, 3), np.float32)
    weights = np.ones((3, count), np.float32)
    slots, shares = add_similar_views(labels, views, quality, detail, weights, around=around)
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-5)
    assert (slots[:, 0] == 0).all()
    assert (shares[eye, 0] > 0.99).all()
    assert np.median(shares[~eye, 0]) < 0.4


def test_levelling_solves_the_screened_poisson_equation() -> None:
    mesh = ellipsoid(2)
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    rng = np.random.default_rng(1)
    count = len(mesh.vertices)
    weights = (rng.uniform(size=(2, count)) < 0.8).astype(np.float32)
    codes = rng.uniform(100, 160, (2, count, 3)).astype(np.float32)
    agreed = rng.uniform(100, 160, (count, 3)).astype(np.float32)
    found = level_views(weights, codes, agreed, around)
    for k in range(2):
        seen = weights[k] > 0
        joined = seen[around.rows] & seen[around.indices]
        entries = (np.full(joined.sum(), LEVELLING), (around.rows[joined], around.indices[joined]))
        beside = scipy.sparse.csr_array(entries, shape=(count, count))
        system = scipy.sparse.diags_array(1 + beside.sum(axis=1)) - beside
        aims = np.where(seen[:, None], agreed - codes[k], 0.0)
        wanted = scipy.sparse.linalg.splu(system.tocsc()).solve(aims.astype(float))
        np.testing.assert_allclose(found[k, :, :3], wanted, atol=0.2)


VERTICES = 2_000
HALF = np.arange(VERTICES) < VERTICES // 2


def face(rng: np.random.Generator) -> np.ndarray:
    """Brightness along a row of vertices, smooth over some thirty."""
    return 0.2 + 0.1 * np.convolve(rng.standard_normal(VERTICES + 30), np.ones(31) / np.sqrt(31.0), "valid")


def views(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    shared = face(rng)
    level = np.stack([(0.6 + 0.2 * k) * shared + 0.01 * rng.standard_normal(VERTICES) for k in range(count)])
    return np.ones((count, VERTICES), np.float32), np.repeat(level[..., None], 3, axis=2).astype(np.float32)


@pytest.mark.parametrize("count", [3, 6])
def test_views_of_one_moment_are_alike_in_any_exposure(count: int) -> None:
    assert find_unlike(*views(count), [HALF, ~HALF]) == {}


@pytest.mark.parametrize("count", [3, 6])
def test_the_view_whose_half_shows_something_else_is_named(count: int) -> None:
    weights, colours = views(count)
    colours[1, ~HALF] = face(np.random.default_rng(8))[~HALF, None]
    found = find_unlike(weights, colours, [HALF, ~HALF])
    assert list(found) == [1]
    assert found[1] < MIN_LIKENESS


def test_no_view_is_named_where_it_shows_little_where_no_two_agree_and_of_two() -> None:
    weights, colours = views(4)
    colours[1] = face(np.random.default_rng(8))[:, None]
    assert find_unlike(weights[:2], colours[:2], [HALF]) == {}
    weights[1, 100:] = 0.0
    assert find_unlike(weights, colours, [HALF]) == {}
    apart = np.stack([np.repeat(face(np.random.default_rng(k))[:, None], 3, axis=1) for k in range(4)])
    assert find_unlike(np.ones_like(weights), apart.astype(np.float32), [HALF]) == {}
