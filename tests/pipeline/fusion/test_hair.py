"""Hair is what lies off the head; it is smoothed, and moved out to its outlines where windows matched its core."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.fusion.fusion import fuse
from pipeline.fusion.hair import (
    INSET_MM,
    OFF_HEAD_MM,
    STUBBLE_MM,
    correct_parts,
    extend_to_outlines,
    loosen_hair,
    smooth_unresolved,
)
from pipeline.fusion.refinement import SeenVertices
from pipeline.imaging.silhouette import ViewQuality, silhouette_from_mask
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes
from pipeline.stereo.depth_map import WindowBias
from rig.mesh import Mesh
from rig.progress import discard_progress
from rig.rig import Rig
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


def bounded(core: Mesh, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Tells where outlines touch the ball, or nearly so, on the side of the cameras; and its other side."""
    towards = np.stack([camera.centre_world / np.linalg.norm(camera.centre_world) for camera in rig])
    cosines = core.normals() @ towards.T
    ahead = cosines.max(axis=1)
    return (np.abs(cosines).min(axis=1) < 0.15) & (ahead > 0.4), ahead < -0.3


def test_core_of_strands_grows_to_its_outlines_and_no_farther(outlines: Scene) -> None:
    """A pixel is 1.4 mm; at a cosine of 0.15 an outline lies 0.7 mm before the ball."""
    core = ball(52.0)
    there, behind = bounded(core, outlines.rig)
    grown, moved_mm = extend_to_outlines(core, np.ones(len(core.vertices)), outlines.silhouettes, outlines.rig)
    assert np.median(radii(grown)[there]) == pytest.approx(OUTLINE_MM - INSET_MM, abs=0.8)
    assert radii(grown).max() < OUTLINE_MM
    assert moved_mm[behind].max() < 0.01


def test_skin_beside_hair_stays(outlines: Scene) -> None:
    core = ball(52.0)
    there, _ = bounded(core, outlines.rig)
    up = core.vertices[:, 1] / 52.0
    grown, moved_mm = extend_to_outlines(core, (up > 0.0).astype(float), outlines.silhouettes, outlines.rig)
    assert moved_mm[up < -0.3].max() < 0.01
    assert np.median(radii(grown)[there & (up > 0.3)]) > 56.5


def test_view_that_is_left_out_says_nothing(outlines: Scene) -> None:
    core, name = ball(56.0), outlines.rig.names[1]
    everywhere = silhouette_from_mask(np.ones_like(outlines.silhouettes[name].mask))
    wrong = {**outlines.silhouettes, name: replace(everywhere, quality=ViewQuality(usable=False))}
    without = {other: each for other, each in outlines.silhouettes.items() if other != name}
    hair = np.ones(len(core.vertices))
    grown, _ = extend_to_outlines(core, hair, wrong, outlines.rig)
    expected, _ = extend_to_outlines(core, hair, without, outlines.rig)
    np.testing.assert_array_equal(grown.vertices, expected.vertices)


def test_head_without_hair_is_not_drawn(outlines: Scene) -> None:
    core = ball(56.0)
    grown, moved_mm = extend_to_outlines(core, np.zeros(len(core.vertices)), outlines.silhouettes, outlines.rig)
    assert grown is core
    assert not moved_mm.any()


@pytest.mark.parametrize(
    ("height_mm", "shown", "part"),
    [
        (0.5 * STUBBLE_MM[0], Part.HAIR, Part.SKIN),
        (STUBBLE_MM[1] + 1.0, Part.HAIR, Part.HAIR),
        (OFF_HEAD_MM + 1.0, Part.SKIN, Part.HAIR),
        (0.5 * STUBBLE_MM[0], Part.CLOTHES, Part.CLOTHES),
    ],
)
def test_height_over_the_head_decides_between_skin_and_hair(height_mm: float, shown: Part, part: Part) -> None:
    places = ball(OUTLINE_MM + height_mm).vertices[::20]
    cells = np.tile((np.arange(3) == shown.channel).astype(float), (len(places), 1))
    votes = PartVotes(places.min(axis=0), np.array([40, 40, 40]), np.arange(len(places)), places, cells)
    shares = correct_parts(votes, ball(OUTLINE_MM)).probability
    assert (shares[:, part.channel] > 0.99).all()


def test_neither_a_neck_off_the_head_nor_a_chest_below_it_is_hair() -> None:
    head, off = ball(OUTLINE_MM), OUTLINE_MM + 20.0
    places = np.array([[0.0, -off, 30.0], [0.0, -0.6 * off, 0.8 * off], [0.0, off, 30.0]])  # chest, neck, hair
    kept = head.faces[head.vertices[head.faces][:, :, 1].min(axis=1) > -0.8 * OUTLINE_MM]
    used, joined = np.unique(kept, return_inverse=True)
    neck = Mesh(head.vertices[used], joined.reshape(-1, 3).astype(np.int32))
    votes = PartVotes(places.min(axis=0), np.array([9, 99, 99]), np.arange(3), places, np.tile([1.0, 0.0, 0.0], (3, 1)))
    assert correct_parts(votes, neck).probability[:, Part.SKIN.channel].tolist() == [1.0, 1.0, 0.0]


def test_scatter_of_strands_is_smoothed_and_skin_stays() -> None:
    rng, mesh = np.random.default_rng(0), ball(OUTLINE_MM)
    noisy = Mesh(mesh.vertices * (1.0 + rng.normal(0.0, 1.0 / OUTLINE_MM, (len(mesh.vertices), 1))), mesh.faces)
    side = mesh.vertices[:, 0]
    held, inner = mesh.vertices[:, 2] > 0.0, mesh.vertices[:, 2] > 55.0  # the cap's edge is smoothed
    hair, none, seen = (side <= 0.0).astype(float), np.zeros(len(side)), SeenVertices.of(noisy.vertices, side < np.inf)
    smooth = smooth_unresolved(noisy, hair, none, none, noise_mm=none, seen=seen, held=held)
    assert np.array_equal(smooth.vertices[inner], noisy.vertices[inner])
    far = mesh.vertices[:, 2] < -30.0
    off = radii(smooth)[(side < -20.0) & far] - OUTLINE_MM
    assert off.std() < 0.25  # of 1 mm: the 45 vertices about one leave a seventh, and near ones count more
    assert np.median(off) == pytest.approx(0.0, abs=0.5)
    skin = (side > 20.0) & far
    assert smooth.vertices[skin] == pytest.approx(noisy.vertices[skin], abs=0.05)


@pytest.mark.parametrize("part", ["clothes", "neck"])
def test_clothes_and_necks_lose_their_gravel_and_keep_their_rims(part: str) -> None:
    rng, mesh = np.random.default_rng(0), ball(OUTLINE_MM)
    rim = np.abs(mesh.vertices[:, 1]) < 4.0  # a belt that stands off by 10 mm
    true = mesh.vertices * (1.0 + rim[:, None] / 6.0)
    noisy = Mesh(true * (1.0 + rng.normal(0.0, 1.0 / OUTLINE_MM, (len(true), 1))), mesh.faces)
    none, every = np.zeros(len(true)), np.ones(len(true))
    seen = SeenVertices.of(noisy.vertices, every > 0.0)
    shown = (every, none) if part == "clothes" else (none, every)
    smooth = smooth_unresolved(noisy, none, *shown, noise_mm=every, seen=seen, held=every < 0.0)
    flat = np.abs(mesh.vertices[:, 1]) > 20.0
    assert (radii(smooth) - OUTLINE_MM)[flat].std() < 0.3  # of 1 mm
    assert (radii(smooth) - OUTLINE_MM)[rim].mean() > 7.0  # the mean alone leaves less than half of it
    assert np.linalg.norm(smooth.vertices - noisy.vertices, axis=1).max() < 2.1


def test_scattered_depth_makes_handles_and_loosened_depth_of_hair_none(outlines: Scene) -> None:
    rng, handles = np.random.default_rng(0), []
    noise = [np.where(each.known, rng.normal(0.0, 4.0, each.known.shape), 0.0) for each in outlines.maps]
    maps = [
        replace(each, depth_mm=(each.depth_mm + off).astype(np.float32))
        for each, off in zip(outlines.maps, noise, strict=True)
    ]
    shown = np.where(np.arange(3) == Part.HAIR.channel, 255, 0).astype(np.uint8)
    labels = {c.name: PartMap(c.name, np.tile(shown, (300, 400, 1))) for c in outlines.rig}
    for scatter in (0.0, 1.0):
        loose = [loosen_hair(each, labels, outlines.rig, scatter) for each in maps]
        mesh = fuse(
            loose, outlines.silhouettes, outlines.rig, None, bias=WindowBias(), spacing_mm=1.5, report=discard_progress
        ).mesh_world
        handles.append(1 - (len(mesh.vertices) - len(mesh.faces) // 2) // 2)
    assert 3 * handles[1] < handles[0]
