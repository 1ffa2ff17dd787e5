"""The closed surface of depth maps whose truth is ellipsoids, without and with planted faults."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.fusion.fusion import BustSurface, NoSurface, finish_bust, fuse, mask_warnings
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.stereo.depth_map import DepthMap, WindowBias
from rig.mesh import Mesh, face_normals
from rig.progress import discard_progress
from rig.rig import Rig
from tests.support.closed_meshes import check_closed
from tests.support.ellipsoid_depths import Ellipsoid, Scene, pinhole_fan, scene
from tests.support.scenes import fan

BALL = Ellipsoid((0, 0, 0), (60, 60, 60))
SPACING_MM = 3.0


def fused(made: Scene, head: Mesh | None = None, spacing_mm: float = SPACING_MM) -> BustSurface:
    surface = fuse(
        made.maps, made.silhouettes, made.rig, head, bias=WindowBias(), spacing_mm=spacing_mm, report=discard_progress
    )
    return finish_bust(surface, None, None, made.silhouettes, made.rig)


def seen_errors(surface: BustSurface, made: Scene) -> np.ndarray:
    return made.distance(surface.mesh_world.vertices)[surface.seen]


@pytest.fixture(scope="module")
def ball() -> Scene:
    return scene([BALL], fan(400, 300))  # with distorting lenses, which the other scenes leave out


def test_ball_is_closed_true_as_it_says_and_the_same_every_time(ball: Scene) -> None:
    """0.2 mm a view, two to five views a vertex, neighbours drawn together: 0.14 mm and less."""
    surface = fused(ball)
    check_closed(surface.mesh_world)
    errors = seen_errors(surface, ball)
    assert np.sqrt((errors**2).mean()) < 0.14
    assert np.abs(errors).max() < 1.0
    assert surface.seen.mean() > 0.55
    assert not surface.warnings
    within = np.abs(seen_errors(surface, ball)) < 2 * surface.deviation_mm[surface.seen]
    assert within.mean() > 0.95
    assert np.median(surface.deviation_mm[surface.seen]) < 0.25
    mesh = surface.mesh_world
    outwards = (face_normals(mesh.vertices, mesh.faces) * mesh.vertices[mesh.faces].mean(axis=1)).sum(axis=1)
    assert (outwards > 0).mean() > 0.99
    again = fused(ball)
    assert again.mesh_world.vertices.tobytes() == mesh.vertices.tobytes()
    assert again.mesh_world.faces.tobytes() == mesh.faces.tobytes()
    assert again.deviation_mm.tobytes() == surface.deviation_mm.tobytes()


def test_spacing_sets_how_many_vertices(ball: Scene) -> None:
    fine = fused(ball, spacing_mm=1.5)
    assert len(fine.mesh_world.vertices) == pytest.approx(4 * len(fused(ball).mesh_world.vertices), rel=0.1)
    assert np.sqrt((seen_errors(fine, ball) ** 2).mean()) < 0.14


def test_unseen_back_follows_the_fitted_head(ball: Scene) -> None:
    """The cameras stand within 75 degrees of the front; a head 2 mm too small all over is right but for those 2 mm."""
    sphere = trimesh.creation.icosphere(5, 58.0)
    open_below = np.asarray(sphere.vertices)[np.asarray(sphere.faces)][:, :, 1].max(axis=1) > -45  # as at a neck
    surface = fused(ball, Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32)[open_below]))
    check_closed(surface.mesh_world)
    unseen = ~surface.seen
    assert (surface.part[unseen] == 0).all()
    assert surface.deviation_mm[unseen].min() > 1.0
    errors = np.abs(ball.distance(surface.mesh_world.vertices[unseen]))
    assert np.percentile(errors, 95) < 5.0
    assert (errors < 2 * surface.deviation_mm[unseen]).mean() > 0.9


def test_hull_closes_the_back_without_a_head(ball: Scene) -> None:
    surface = fused(ball)
    back = surface.mesh_world.vertices[~surface.seen]
    assert back[:, 2].min() < -55.0
    for camera in ball.rig:
        pixels = np.rint(camera.project(surface.mesh_world.vertices)).astype(int)
        assert ball.silhouettes[camera.name].distance[pixels[:, 1], pixels[:, 0]].max() < 4.0


@pytest.mark.slow
def test_thin_ear_stands() -> None:
    """A shell 5 mm thick that leaves the ball by 24 mm, seen from its edge and from both of its sides."""
    ear = Ellipsoid((64, 0, 0), (22, 24, 2.5))
    surface = fused(scene([BALL, ear]), spacing_mm=1.5)
    check_closed(surface.mesh_world)
    assert surface.mesh_world.vertices[:, 0].max() == pytest.approx(86.0, abs=1.5)


def with_patch(depth_map: DepthMap, nearer_mm: float, rows: slice, columns: slice) -> DepthMap:
    """A sheet that one view is sure of, so much nearer than the surface."""
    depth = depth_map.depth_mm.copy()
    depth[rows, columns] -= np.where(depth_map.known[rows, columns], nearer_mm, 0).astype(np.float32)
    return replace(depth_map, depth_mm=depth)


@pytest.mark.parametrize("nearer_mm", [40.0, 6.0, -6.0])
def test_free_space_of_other_views_removes_a_sheet(ball: Scene, nearer_mm: float) -> None:
    maps = list(ball.maps)
    maps[3] = with_patch(maps[3], nearer_mm, slice(140, 160), slice(195, 215))
    faulty = replace(ball, maps=tuple(maps))
    surface = fused(faulty)
    check_closed(surface.mesh_world)
    assert np.abs(seen_errors(surface, faulty)).max() < 1.5


def test_wrong_mask_of_one_view_cuts_nothing_that_others_see(ball: Scene) -> None:
    silhouettes = dict(ball.silhouettes)
    mask = silhouettes["cam03"].mask.copy()
    mask[:, :190] = False
    silhouettes["cam03"] = silhouette_from_mask(mask)
    surface = fused(replace(ball, silhouettes=silhouettes))
    check_closed(surface.mesh_world)
    errors = np.abs(seen_errors(surface, ball))
    assert np.percentile(errors, 99) < 1.0
    assert errors.max() < 6.0  # a few vertices beside what the wrong mask leaves out, at the edge of what is seen
    assert [(warning.code, warning.text[:5]) for warning in surface.warnings] == [("mask-contradicted", "cam03")]
    assert surface.seen.sum() > 0.95 * fused(ball).seen.sum()


def test_soft_masks_that_lack_a_little_in_every_view_warn_of_none() -> None:
    names = [f"cam{k:02}" for k in range(16)]
    soft = np.linspace(0.003, 0.015, 16)  # what published soft masks of sixteen cameras lack
    assert [*mask_warnings(names, soft)] == []
    one_cut = np.where(np.arange(16) == 5, 0.08, soft)
    assert [warning.text[:5] for warning in mask_warnings(names, one_cut)] == ["cam05"]
    alone = np.where(np.arange(16) == 5, 0.003, 0.0)
    assert [warning.text[:5] for warning in mask_warnings(names, alone)] == ["cam05"]
    assert len([*mask_warnings(names, np.full(16, 0.05))]) == 16


@pytest.mark.slow
def test_camera_half_a_pixel_off_leaves_no_spike(ball: Scene) -> None:
    """Half a pixel is 0.9 mm across the ray here, and as much along it where the surface is steep."""
    rig = pinhole_fan()
    k = rig["cam02"].intrinsics
    moved = replace(rig["cam02"], intrinsics=replace(k, cx=k.cx + 0.5))
    true_rig = Rig(tuple(moved if camera.name == "cam02" else camera for camera in rig))
    faulty = scene([BALL], rig, true_rig=true_rig)
    surface = fused(faulty)
    check_closed(surface.mesh_world)
    errors = seen_errors(surface, faulty)
    assert np.sqrt((errors**2).mean()) < 0.3
    assert np.abs(errors).max() < 1.5


@pytest.mark.slow
def test_hand_before_the_face_stands_apart_or_joined_but_closed(ball: Scene) -> None:
    hand = Ellipsoid((10, -5, 100), (18, 25, 9))
    made = scene([BALL, hand])
    surface = fused(made)
    check_closed(surface.mesh_world)
    assert np.abs(seen_errors(surface, made)).max() < 3.0


@pytest.mark.slow
def test_a_larger_body_behind_takes_nothing_from_the_subject(ball: Scene) -> None:
    """35 cm behind and to the side, in the masks of all views and before the subject in some."""
    made = scene([BALL, Ellipsoid((60, 0, -350), (70, 70, 70))], fan(400, 300))
    sphere = trimesh.creation.icosphere(4, 58.0)
    surface = fused(made, Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32)))
    check_closed(surface.mesh_world)
    assert np.abs(seen_errors(surface, made)).max() < 3.0
    assert np.linalg.norm(surface.mesh_world.vertices, axis=1).max() < 100.0
    ours = np.abs(BALL.distance(surface.mesh_world.vertices[surface.seen])) < 1.0
    assert ours.sum() > 0.95 * fused(ball).seen.sum()


def test_strands_leave_no_spike(ball: Scene) -> None:
    """Outlines with hairs a pixel wide and depths of the wall behind them: 20 strands a view."""
    rng = np.random.default_rng(3)
    maps, silhouettes = [], {}
    for depth_map in ball.maps:
        mask = ball.silhouettes[depth_map.camera.name].mask.copy()
        rows, columns = np.nonzero(mask)
        middle = np.array([rows.mean(), columns.mean()])
        for angle in rng.uniform(0, 2 * np.pi, 20):
            along = middle + np.arange(20, 50)[:, None] * (np.sin(angle), np.cos(angle))
            mask[tuple(np.rint(along).astype(int).T)] = True
        silhouettes[depth_map.camera.name] = silhouette_from_mask(mask)
        maps.append(depth_map)
    surface = fused(replace(ball, silhouettes=silhouettes))
    check_closed(surface.mesh_world)
    assert np.linalg.norm(surface.mesh_world.vertices[surface.mesh_world.vertices[:, 2] > 0], axis=1).max() < 63.0


def test_fewer_than_three_views_give_no_surface(ball: Scene) -> None:
    with pytest.raises(NoSurface, match="2 of the photographs"):
        fused(replace(ball, maps=ball.maps[:2]))
