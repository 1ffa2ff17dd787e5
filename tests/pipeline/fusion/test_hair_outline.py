"""Hair is moved out to its outlines where windows matched its core, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.fusion.hair import grown_to_outlines
from pipeline.imaging.silhouette import ViewQuality, silhouette_from_mask
from rig.mesh import Mesh
from tests.support.ellipsoid_depths import Ellipsoid, Scene, scene
from tests.support.scenes import fan

OUTLINE_MM = 60.0


@pytest.fixture(scope="module")
def outlines() -> Scene:
    return scene([Ellipsoid((0, 0, 0), (OUTLINE_MM, OUTLINE_MM, OUTLINE_MM))], fan(400, 300))


def ball(radius_mm: float) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=5, radius=radius_mm)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces))


def radii(mesh: Mesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices, axis=1)


def test_core_of_strands_grows_to_the_outline(outlines: Scene) -> None:
    """Of 4 mm that are missing, 0.7 and 0.7 of the rest are added; a pixel is 1.4 mm."""
    core = ball(56.0)
    grown, moved_mm = grown_to_outlines(core, np.ones(len(core.vertices)), outlines.silhouettes, outlines.rig)
    assert np.median(radii(grown)) == pytest.approx(59.6, abs=0.1)
    assert radii(grown) == pytest.approx(59.6, abs=0.6)
    assert moved_mm == pytest.approx(3.6, abs=0.6)


def test_hair_that_reaches_its_outline_stays(outlines: Scene) -> None:
    solid = ball(59.8)
    grown, moved_mm = grown_to_outlines(solid, np.ones(len(solid.vertices)), outlines.silhouettes, outlines.rig)
    assert grown is solid
    assert not moved_mm.any()


def test_skin_beside_hair_stays(outlines: Scene) -> None:
    core = ball(56.0)
    up = core.vertices[:, 1] / 56.0
    grown, moved_mm = grown_to_outlines(core, (up > 0.0).astype(float), outlines.silhouettes, outlines.rig)
    assert moved_mm[up < -0.3].max() < 0.01
    assert np.median(radii(grown)[up > 0.3]) > 59.0


def test_single_hairs_do_not_carry_the_surface_along(outlines: Scene) -> None:
    """A tenth of the outline stands 12 mm farther out than the rest."""
    core = ball(56.0)
    turn = np.arctan2(core.vertices[:, 1], core.vertices[:, 0])
    short = np.abs(np.sin(6 * turn)) < 0.156  # a tenth
    dented = Mesh(core.vertices * np.where(short, 44.0 / 56.0, 1.0)[:, None], core.faces)
    grown, _ = grown_to_outlines(dented, np.ones(len(core.vertices)), outlines.silhouettes, outlines.rig)
    assert np.median(radii(grown)[~short]) < OUTLINE_MM + 0.5


def test_view_that_is_left_out_says_nothing(outlines: Scene) -> None:
    core, name = ball(56.0), outlines.rig.names[1]
    everywhere = silhouette_from_mask(np.ones_like(outlines.silhouettes[name].mask))
    wrong = {**outlines.silhouettes, name: replace(everywhere, quality=ViewQuality(usable=False))}
    without = {other: each for other, each in outlines.silhouettes.items() if other != name}
    hair = np.ones(len(core.vertices))
    grown, _ = grown_to_outlines(core, hair, wrong, outlines.rig)
    expected, _ = grown_to_outlines(core, hair, without, outlines.rig)
    np.testing.assert_array_equal(grown.vertices, expected.vertices)


def test_head_without_hair_is_not_drawn(outlines: Scene) -> None:
    core = ball(56.0)
    grown, moved_mm = grown_to_outlines(core, np.zeros(len(core.vertices)), outlines.silhouettes, outlines.rig)
    assert grown is core
    assert not moved_mm.any()
