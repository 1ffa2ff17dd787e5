"""Albedo of an ellipsoid of skin whose photographs are ray-traced in two lights."""

import numpy as np
import pytest

from pipeline.geometry.projection import depth_maps
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.settings import TextureSettings
from pipeline.texturing.albedo import DIM_SHARE, Albedo, estimate_albedo, shine_left
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout, unwrap
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from pipeline.texturing.paint import paint_texture
from pipeline.texturing.vertex_colours import Texture, colour_vertices, underexposed_views
from rig.camera import Camera
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.mesh import Mesh
from tests.pipeline.texturing.test_paint import without_neck
from tests.support.colour_difference import difference_2000, lab_from_srgb
from tests.support.face_texels import face_texels, texels
from tests.support.photographs import SCREEN, hits
from tests.support.scenes import ellipsoid, fan, pattern

SKIN = np.array([0.45, 0.30, 0.22])
LAMPS = {  # towards, its light, even light; the mean over the sphere is 0.95 of each
    "left": (np.array([0.8, 0.3, 0.52]), 1.8, 0.5),
    "top": (np.array([-0.1, 0.9, 0.42]), 1.4, 0.6),
}
GLOSS = 0.25


def skin(points: np.ndarray) -> np.ndarray:
    return SKIN * (1 + 0.33 * (pattern(points)[:, :1] - 0.4))


def photograph(camera: Camera, lamp: tuple[np.ndarray, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """sRGB codes and mask: matt skin, and a highlight that moves with the camera."""
    towards, strength, even = lamp[0] / np.linalg.norm(lamp[0]), lamp[1], lamp[2]
    hit, points, normals, mirrored = hits(camera, towards)
    lit = even + strength * np.clip(normals @ towards, 0, None)
    light = np.tile(np.array(SCREEN), (len(hit), 1))
    light[hit] = skin(points) * lit[:, None] + GLOSS * mirrored[:, None]
    shape = (camera.intrinsics.height, camera.intrinsics.width)
    codes = np.rint(255 * srgb_from_linear(light.reshape(*shape, 3))).astype(np.uint8)
    return codes, hit.reshape(shape)


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return without_neck(ellipsoid(4))


@pytest.fixture(scope="module")
def layout(mesh: Mesh) -> Layout:
    return unwrap(mesh.vertices, mesh.faces)


@pytest.fixture(scope="module")
def found(mesh: Mesh, layout: Layout) -> dict[str, tuple[Atlas, Albedo, np.ndarray]]:
    rig, normals = fan(), mesh.normals()
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    out = {}
    for name, lamp in LAMPS.items():
        shots = {camera.name: photograph(camera, lamp) for camera in rig}
        capture = Capture({key: codes for key, (codes, _) in shots.items()})
        silhouettes = {key: silhouette_from_mask(mask) for key, (_, mask) in shots.items()}
        depths, settings = depth_maps(rig, mesh), TextureSettings()
        coloured = colour_vertices(
            mesh, capture, silhouettes, rig, depths, settings=settings, around=around, dim_share=DIM_SHARE
        )
        assert coloured.decision is not None
        atlas = paint_texture(layout, mesh, coloured.colours, coloured.decision, 1024)
        albedo, warnings = estimate_albedo(mesh, normals, coloured, atlas, np.ones(len(normals), bool), around)
        assert albedo is not None
        assert not warnings
        out[name] = (atlas, albedo, coloured.views > 0)
    return out


@pytest.mark.slow
def test_albedos_of_two_lights_are_alike(layout: Layout, found: dict[str, tuple[Atlas, Albedo, np.ndarray]]) -> None:
    (left, left_albedo, one), (top, top_albedo, other) = found.values()
    face = face_texels(layout, one & other)
    lab = [lab_from_srgb(texels(a.image, face)) for a in (left, top, left_albedo.atlas, top_albedo.atlas)]
    assert difference_2000(lab[2], lab[3]).mean() < difference_2000(lab[0], lab[1]).mean() / 3


@pytest.mark.slow
def test_the_albedo_is_the_skins_own_by_the_mean_light_which_comes_from_the_lamp(
    mesh: Mesh, layout: Layout, found: dict[str, tuple[Atlas, Albedo, np.ndarray]]
) -> None:
    """A lamp that lights a facing white by c is c / 4 over the sphere."""
    for name, (_, albedo, seen) in found.items():
        _, strength, even = LAMPS[name]
        uv = layout.uv[: len(mesh.vertices)]
        column, row = np.floor(1024 * uv).astype(int).clip(0, 1023).T
        image = linear_from_srgb(albedo.atlas.image[row, column] / 255.0)
        ratio = (image / (skin(mesh.vertices) * (even + strength / 4)))[seen]
        # Nobody sees the light from behind, a third of the sphere.
        assert np.median(ratio) == pytest.approx(1.0, abs=0.12)
        # The second order leaves 0.036 (rms) of a lamp's cosine: max(0, c) = 1/4 + c/2 + 5/16 P2(c) + ..., and
        # 1/6 - 1/16 - 1/12 - 5/256 = 0.0013. Of 1.8 that is 0.13 of the side that has 0.5, 0.05 of the other: 0.1.
        assert np.std(ratio / np.median(ratio)) < 0.11
        y, z, x = albedo.light.coefficients[1:4].mean(axis=1)
        towards = np.array([x, y, z]) / np.linalg.norm([x, y, z])
        assert towards @ (LAMPS[name][0] / np.linalg.norm(LAMPS[name][0])) > np.cos(np.radians(15))


def test_a_wide_highlight_is_taken_off_and_noise_is_not(mesh: Mesh) -> None:
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    rng = np.random.default_rng(2)
    shown = SKIN * np.ones((len(mesh.vertices), 3))
    dim = shown * rng.normal(0.97, 0.02, (len(shown), 1))  # a dim view is dimmer everywhere, by noise
    shiny = np.linalg.norm(mesh.vertices - mesh.vertices[np.argmax(mesh.vertices[:, 2])], axis=1)
    dim[shiny < 40] *= 0.7
    left = shine_left(shown, dim, np.ones(len(shown), bool), around)
    assert left[shiny < 10] == pytest.approx(0.7, abs=0.03)
    assert left[shiny > 90].min() > 0.98


def test_a_dim_view_is_the_one_at_its_share_of_the_weight() -> None:
    colours = np.array([0.9, 0.2, 0.5, 0.1], np.float32)[:, None, None] * np.ones((1, 2, 3), np.float32)
    weights = np.array([[1, 0], [1, 0], [1, 0], [0, 0]], np.float32)
    found = underexposed_views(weights, colours, 0.3)
    np.testing.assert_allclose(found, [[0.2] * 3, [0.0] * 3])  # the unseen view is dimmer, and does not count


def test_a_black_face_or_none_with_a_texture_has_no_albedo_and_a_warning(mesh: Mesh, layout: Layout) -> None:
    count = len(mesh.vertices)
    grey = Texture(np.full((count, 3), 120, np.uint8), np.ones(count, np.uint8))
    black = Texture(np.zeros((count, 3), np.uint8), np.ones(count, np.uint8), dim=np.zeros((count, 3), np.float32))
    atlas = Atlas(layout, np.zeros((64, 64, 3), np.uint8))
    around = Neighbourhood.of(*neighbours(mesh.faces, count))
    for texture_with in ((grey, None), (black, atlas)):
        albedo, warnings = estimate_albedo(mesh, mesh.normals(), *texture_with, np.ones(count, bool), around)
        assert albedo is None
        assert [warning.code for warning in warnings] == ["no-albedo"]
