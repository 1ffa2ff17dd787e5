"""A shiny ellipsoid of skin in the simulated studio, whose polarised pictures and their truth are known."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipeline.geometry.projection import depth_maps, project_points
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.settings import TextureSettings
from pipeline.texturing.layout.uv_unwrap import Atlas, ModelLayout, unwrap
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from pipeline.texturing.paint import paint_texture
from pipeline.texturing.sets.specular import measure_exposures
from pipeline.texturing.sets.texture_sets import SetTextures, colour_by_sets
from pipeline.texturing.vertex_colours import colour_vertices
from pipeline.texturing.visibility import Decision
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.studio.scene.simulate import Scene, simulate
from rig.studio.scene.subject import SKIN_TONES, Look, Subject
from tests.pipeline.texturing.test_paint import without_neck
from tests.support.scenes import ellipsoid, fan
from tests.support.small_studio import CLEAN

pytestmark = pytest.mark.gl

SIZE = 512
SHINY = replace(CLEAN, noise=0.01, defocus_px=0.4, exposure_spread=0.05, oil=3.0, pores=0.0, polarised=True)
LOOK = Look(SKIN_TONES[1], SKIN_TONES[1], None, freckles=0.0)
SETTINGS = TextureSettings()


@dataclass(frozen=True, eq=False)
class Coloured:
    """The ellipsoid with its texture, what texture sets are coloured by, and the studio's truth."""

    mesh: Mesh
    capture: Capture
    scene: Scene
    silhouettes: Mapping[str, Silhouette]
    layout: ModelLayout
    decision: Decision
    atlas: Atlas
    seen: np.ndarray  # vertices that two views see
    truth: np.ndarray  # linear, scattered light of each vertex

    def by_sets(self, sets: Mapping[str, Mapping[str, ImageRgb]]) -> tuple[SetTextures, list[str]]:
        """The textures of some sets, and the codes of the warnings."""
        found, warnings = colour_by_sets(
            sets, self.decision, self.mesh, self.silhouettes, self.layout, atlas=self.atlas, settings=SETTINGS
        )
        assert found is not None
        return found, [warning.code for warning in warnings]

    def at_vertices(self, image: np.ndarray) -> np.ndarray:
        """Texels of an image at the vertices that are seen."""
        column, row = np.floor(SIZE * self.layout.layout.uv[: len(self.mesh.vertices)]).astype(int).clip(0, SIZE - 1).T
        return image[row, column][self.seen]

    def mirrored(self) -> np.ndarray:
        """The light that the surface mirrors, at the vertices that are seen: its mean over the views, as weighted."""
        total, weights = np.zeros((len(self.mesh.vertices), 3)), np.full((len(self.mesh.vertices), 1), 1e-12)
        for camera, weight in zip(self.decision.views, self.decision.weights, strict=True):
            view = self.scene.views[camera.name]
            assert view.matt is not None
            light = (view.subject - view.matt)[:, :, :3]
            height, width = light.shape[:2]
            column, row = np.rint(project_points(camera, self.mesh.vertices)).astype(int).T
            total += weight[:, None] * light[row.clip(0, height - 1), column.clip(0, width - 1)]
            weights += weight[:, None]
        return (total / weights)[self.seen]


@pytest.fixture(scope="module")
def shiny(renderer) -> Coloured:
    mesh, rig = without_neck(ellipsoid(4)), fan(azimuths_deg=(-60, -30, 0, 30, 60))
    taken = simulate(Subject(mesh), rig, SHINY, np.random.default_rng(3), renderer=renderer, look=LOOK)
    mesh = Mesh(taken.scene.head.vertices, mesh.faces)
    silhouettes = {name: silhouette_from_mask(mask) for name, mask in taken.masks.items()}
    layout = ModelLayout(
        unwrap(mesh.vertices, mesh.faces), Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    )
    found = colour_vertices(
        mesh, taken.capture, silhouettes, rig, depth_maps(rig, mesh), settings=SETTINGS, around=layout.around
    )
    assert found.decision is not None
    assert taken.scene.head.colours is not None
    atlas = paint_texture(layout.layout, mesh, found.colours, found.decision, SIZE)
    truth = linear_from_srgb(taken.scene.head.colours / 255.0)
    return Coloured(
        mesh, taken.capture, taken.scene, silhouettes, layout, found.decision, atlas, found.views >= 2, truth
    )


@pytest.fixture(scope="module")
def found(shiny: Coloured) -> SetTextures:
    sets, warnings = shiny.by_sets(shiny.capture.texture_sets)
    assert not warnings
    return sets


def error_db(light: np.ndarray, truth: np.ndarray) -> float:
    """RMS difference in decibels of the truth's, a common exposure in each channel taken out."""
    scale = (light * truth).sum(axis=0) / (light**2).sum(axis=0)
    return float(20 * np.log10(np.sqrt(np.mean((scale * light - truth) ** 2) / np.mean(truth**2))))


def test_the_diffuse_texture_is_nearer_to_scattered_light_than_a_plain_one(shiny: Coloured, found: SetTextures) -> None:
    assert found.diffuse is not None
    truth = shiny.truth[shiny.seen]
    plain, diffuse = (
        error_db(linear_from_srgb(shiny.at_vertices(atlas.image) / 255.0), truth)
        for atlas in (shiny.atlas, found.diffuse)
    )
    assert diffuse < -32.0
    assert diffuse < plain - 3.0


def test_specular_light_is_what_the_surface_mirrors_and_nothing_elsewhere(shiny: Coloured, found: SetTextures) -> None:
    assert found.specular is not None
    light, truth = shiny.at_vertices(found.specular.light.astype(float)), shiny.mirrored()
    dull, bright = truth.max(axis=1) < 0.002, truth.max(axis=1) > 0.05
    assert dull.mean() > 0.2
    assert light[dull].mean() < 0.003
    assert bright.sum() > 20
    assert np.median(light[bright] / truth[bright]) == pytest.approx(1.0, abs=0.1)


def test_every_set_has_a_texture_of_the_heads_size(shiny: Coloured, found: SetTextures) -> None:
    assert set(found.atlases) == {"cross", "parallel"}
    assert all(atlas.image.shape == shiny.atlas.image.shape for atlas in found.atlases.values())
    light = {name: shiny.at_vertices(atlas.image).astype(float).mean() for name, atlas in found.atlases.items()}
    assert light["parallel"] > light["cross"]


def exposed(images: Mapping[str, ImageRgb], share: float) -> dict[str, ImageRgb]:
    """The pictures, exposed for another time."""
    table = np.rint(255 * srgb_from_linear(np.clip(share * linear_from_srgb(np.arange(256) / 255.0), 0, 1)))
    return {name: table.astype(np.uint8)[image] for name, image in images.items()}


def test_another_exposure_of_the_parallel_pictures_is_found_and_taken_out(shiny: Coloured, found: SetTextures) -> None:
    sets = shiny.capture.texture_sets
    ratios = measure_exposures(
        sets["cross"], exposed(sets["parallel"], 0.6), shiny.silhouettes, shiny.decision.views.names
    )
    assert list(ratios.values()) == pytest.approx([0.6] * 5, rel=0.02)
    darker, _ = shiny.by_sets({"cross": sets["cross"], "parallel": exposed(sets["parallel"], 0.6)})
    assert darker.specular is not None
    assert found.specular is not None
    off = shiny.at_vertices(darker.specular.light.astype(float)) - shiny.at_vertices(found.specular.light.astype(float))
    assert np.median(np.abs(off)) < 0.004


def test_one_set_alone_has_a_texture_and_sets_that_are_exchanged_or_unused_are_told(shiny: Coloured) -> None:
    sets = shiny.capture.texture_sets
    one, warnings = shiny.by_sets({"ultraviolet": sets["cross"]})
    assert (one.specular, one.diffuse, warnings) == (None, None, [])
    assert set(one.atlases) == {"ultraviolet"}
    _, warnings = shiny.by_sets({"cross": sets["parallel"], "parallel": sets["cross"]})
    assert warnings == ["texture-sets-exchanged"]
    found, unused = colour_by_sets(sets, None, shiny.mesh, shiny.silhouettes, None, atlas=None, settings=SETTINGS)
    assert found is None
    assert [warning.code for warning in unused] == ["texture-sets-unused"]
