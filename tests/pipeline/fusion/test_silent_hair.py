"""Hair that windows match only here and there becomes a smooth shell, as deep inside its outlines as they say."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.fusion.fusion import finish_bust, fuse
from pipeline.fusion.hair import Places, distance_to_hull, find_silent_hair, local_share, only_where, remove_specks
from pipeline.fusion.view_stack import stack_views
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes, vote_parts
from pipeline.stereo.depth_map import DepthMap, WindowBias
from rig.camera import Camera
from rig.mesh import Mesh
from rig.progress import discard_progress
from rig.rig import Rig
from tests.support.closed_meshes import check_closed
from tests.support.ellipsoid_depths import Ellipsoid, Scene, known_depth, look, pinhole, scene
from tests.support.scenes import fan, pixel_grid

OUTLINE_MM, CORE_MM, SHIRT_MM = 60.0, 54.0, -15.0
OUTER, CORE = (Ellipsoid((0, 0, 0), (radius, radius, radius)) for radius in (OUTLINE_MM, CORE_MM))
CIRCLE_DEG = tuple(range(-180, 180, 30))


@pytest.fixture(scope="module")
def strands() -> Scene:
    """A ball of hair above a shirt, from all around. The shirt's depth is known; of the hair's core a twelfth is, in
    specks that scatter by 3 mm."""
    rig = Rig(tuple(pinhole(camera) for camera in fan(200, 150, CIRCLE_DEG)))
    ball, rng = scene([OUTER], rig), np.random.default_rng(5)
    maps = []
    for camera in rig:
        shirt, hair = known_depth(camera, [OUTER], 0.2, rng), known_depth(camera, [CORE], 0.2, rng)
        above = heights(camera) > SHIRT_MM
        maps.append(joined(shirt, above, specks(hair, rng)))
    return replace(ball, maps=tuple(maps))


def heights(camera: Camera) -> np.ndarray:
    """World y (mm) of the ball at every pixel; 0 beside it."""
    depth, _ = look(camera, [OUTER])
    rays = camera.rays_world(pixel_grid(camera))
    along = depth.ravel() / (rays @ camera.camera_from_world.rotation[2])
    return np.where(np.isfinite(along), camera.centre_world[1] + along * rays[:, 1], 0.0).reshape(depth.shape)


def specks(depth_map: DepthMap, rng: np.random.Generator) -> DepthMap:
    rows, columns = depth_map.depth_mm.shape
    blocks = (rows // 3 + 1, columns // 3 + 1)
    chosen, off_mm = rng.random(blocks) < 1 / 12, rng.normal(0.0, 3.0, blocks)
    chosen, off_mm = (np.kron(each, np.ones((3, 3)))[:rows, :columns] for each in (chosen, off_mm))
    moved = replace(depth_map, depth_mm=(depth_map.depth_mm + off_mm).astype(np.float32))
    return only_where(depth_map.known & (chosen > 0), moved)


def joined(one: DepthMap, other_where: np.ndarray, other: DepthMap) -> DepthMap:
    names = ("depth_mm", "normal", "deviation_mm", "views")
    pairs = {name: (getattr(one, name), getattr(other, name)) for name in names}
    masks = {name: other_where[..., None] if name == "normal" else other_where for name in names}
    return replace(one, **{name: np.where(masks[name], b, a) for name, (a, b) in pairs.items()})


def labels(made: Scene, above: Part) -> dict[str, PartMap]:
    maps = {}
    for camera in made.rig:
        mask, up = made.silhouettes[camera.name].mask, heights(camera) > SHIRT_MM
        shown = np.zeros((*mask.shape, 3), np.uint8)
        shown[mask & up, above.channel] = 255
        shown[mask & ~up, Part.CLOTHES.channel] = 255
        maps[camera.name] = PartMap(camera.name, shown)
    return maps


def head() -> Mesh:
    sphere = trimesh.creation.icosphere(4, CORE_MM)
    return Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32))


def split(made: Scene, above: Part) -> tuple[Places | None, Sequence[DepthMap], PartVotes | None]:
    parts = labels(made, above)
    votes = vote_parts(made.maps, parts, made.rig)
    return *find_silent_hair(made.maps, parts, votes, made.rig)[:2], votes


def test_specks_become_a_smooth_shell_that_counts_as_unseen(strands: Scene) -> None:
    hair, maps, votes = split(strands, Part.HAIR)
    assert hair is not None
    bias = WindowBias()
    made = fuse(
        maps, strands.silhouettes, strands.rig, head(), bias=bias, spacing_mm=3.0, report=discard_progress, hair=hair
    )
    surface = finish_bust(made, votes, None, strands.silhouettes, strands.rig)
    check_closed(surface.mesh_world)
    above = surface.mesh_world.vertices[:, 1] > 5.0
    radii = np.linalg.norm(surface.mesh_world.vertices[above], axis=1)
    assert np.median(radii) == pytest.approx(CORE_MM, abs=2.0)  # a pixel is 2.8 mm
    assert np.percentile(np.abs(radii - np.median(radii)), 95) < 2.0
    assert not surface.seen[above].any()
    assert (surface.part[above] == Part.UNSEEN).all()
    assert 1.5 < np.median(surface.deviation_mm[above]) < 4.0  # the specks scatter by 3 mm
    assert surface.seen[surface.mesh_world.vertices[:, 1] < -25.0].mean() > 0.5


def test_depth_inside_the_hull_is_what_outlines_say(strands: Scene) -> None:
    views = stack_views(strands.maps, strands.silhouettes, strands.rig)
    places = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, CORE_MM], [0.0, 0.0, OUTLINE_MM + 5.0]])
    assert distance_to_hull(places, views) == pytest.approx([-60.0, -6.0, 5.0], abs=2.8)  # a pixel


def test_solid_hair_and_a_bald_head_stay_as_they_are(strands: Scene) -> None:
    solid = scene([OUTER], strands.rig)
    for made, above in ((solid, Part.HAIR), (strands, Part.SKIN)):
        hair, maps, _ = split(made, above)
        assert hair is None
        assert maps is made.maps


def test_chance_depth_of_a_plain_shirt_is_left_out(strands: Scene) -> None:
    solid, parts = scene([OUTER], strands.rig).maps[0], labels(strands, Part.SKIN)
    rare = only_where(np.random.default_rng(0).random(solid.known.shape) < 0.1, solid)
    assert remove_specks(solid, parts, strands.rig) is solid
    assert remove_specks(rare, parts, strands.rig).known.sum() < 0.1 * rare.known.sum()


def test_share_counts_the_subject_alone(strands: Scene) -> None:
    """At its outline half of a window is wall."""
    solid = scene([OUTER], strands.rig)
    share = local_share(solid.maps[0], labels(solid, Part.HAIR), strands.rig)
    assert np.percentile(share[solid.maps[0].known], 5) > 0.6
    assert share[0, 0] == 0.0
