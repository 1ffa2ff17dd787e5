"""The coloured whole surface: its colours are the photographs', its files what docs/capture-format.md says."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.contour_fit.fit import Fit
from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.depth_bias import points_on_face
from pipeline.head_model.model import load_model
from pipeline.part_labels.codes import Part
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.write import write_result
from pipeline.settings import BustSettings, OutputSettings, Settings
from pipeline.stages.bust import Bust, colour_bust, fuse_depth, push_out_hair, shape_bust
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import Depth
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.views import Views
from pipeline.stereo.depth_map import WindowBias
from pipeline.warnings import Detail
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.formats.meshes.ply import read_head_ply
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.messages.message import verbatim
from rig.render.renderer import Renderer
from tests.support.ellipsoid_depths import Ellipsoid, look, pinhole_fan, scene
from tests.support.made_up_results import made_up_result
from tests.support.scenes import pattern, pixel_grid

BALL = Ellipsoid((0, 0, 0), (60, 60, 60))
SETTINGS = Settings(bust=BustSettings(spacing_mm=3.0))
PLACE = Similarity(1.25, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))


@pytest.fixture(scope="module")
def photographed(renderer: Renderer) -> tuple[Bust, Capture, dict]:
    """A ball whose colours are known at every point, and its bust."""
    made = scene([BALL], pinhole_fan())
    images = {}
    for camera in made.rig:
        depth, _ = look(camera, [BALL])
        rays = camera.rays_world(pixel_grid(camera))
        along = depth.ravel() / (rays @ camera.camera_from_world.rotation[2])
        points = camera.centre_world + np.where(np.isfinite(along), along, 0)[:, None] * rays
        light = np.where(np.isfinite(along)[:, None], pattern(points), 0.05)
        images[camera.name] = np.rint(255 * srgb_from_linear(light)).astype(np.uint8).reshape(*depth.shape, 3)
    sphere = trimesh.creation.icosphere(4, 60.0)
    head, capture = Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32)), Capture(images)
    context = ReconstructionContext(capture, made.rig, load_model(), SETTINGS, renderer)
    nothing = SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.uint8))
    bias = WindowBias()
    depth = Depth(made.maps, images, None, nothing, points_on_face(nothing, head, np.zeros(0, bool)), bias)
    refined = RefinedHead(head, np.ones(len(head.vertices)), Detail("photo", verbatim("planted")))
    views = Views(capture, made.silhouettes, {})
    fused = fuse_depth(context, views, head, PartLabels({}), depth).product
    surface = shape_bust(context, views, depth.votes, refined, fused).product
    bust = colour_bust(context, views, PartLabels({}), surface, capture, np.eye(3)).product
    assert bust is not None
    return bust, capture, made.silhouettes


@pytest.fixture(scope="module")
def result(photographed) -> Reconstruction:
    bust, _, silhouettes = photographed
    head = bust.mesh_world
    return made_up_result(
        head,
        Fit("contour", np.zeros(2), PLACE, 1, "planted"),
        colours=bust.colours,
        views=bust.views,
        deviation_mm=np.full(len(head.vertices), 0.5),
        silhouettes=silhouettes,
        fitted_masks={name: silhouette.mask for name, silhouette in silhouettes.items()},
        name="ball",
        front="cam03",
        settings=SETTINGS,
        bust=bust,
    )


def test_colours_are_those_of_the_photographs(photographed) -> None:
    """Codes are rounded twice, sampled in a window of 0.45 px and blurred by 0.1 mm of depth: two or three levels."""
    bust, _, _ = photographed
    expected = 255 * srgb_from_linear(pattern(bust.mesh_world.vertices))
    several = bust.views > 1
    assert several.mean() > 0.5
    assert np.median(np.abs(bust.colours[several] - expected[several])) < 3.0


def test_files_hold_what_the_contract_says(result: Reconstruction, photographed, tmp_path: Path) -> None:
    bust, capture, _ = photographed
    write_result(tmp_path, result, capture)
    data = (tmp_path / "bust.ply").read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    properties = [line.split()[2] for line in data[:end].decode().splitlines() if line.startswith("property")][:-1]
    assert properties == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "quality", "views", "part"]
    kinds = ["<f4"] * 6 + ["u1"] * 3 + ["<f4", "u1", "u1"]
    read = np.frombuffer(data, np.dtype(list(zip(properties, kinds, strict=True))), len(bust.views), end)
    np.testing.assert_allclose(np.stack([read[n] for n in "xyz"], 1), bust.mesh_world.vertices, atol=1e-4)
    np.testing.assert_array_equal(read["part"], bust.surface.part)
    np.testing.assert_allclose(read["quality"], bust.surface.deviation_mm, rtol=1e-6)
    glb = trimesh.load(tmp_path / "bust.glb", force="mesh")
    assert isinstance(glb, trimesh.Trimesh)
    expected = (bust.mesh_world.vertices - PLACE.translation) @ PLACE.rotation / 1000
    np.testing.assert_allclose(glb.vertices[: len(expected)], expected, atol=1e-5)  # seams repeat some of them
    section = json.loads((tmp_path / "report.json").read_text())["bust"]
    assert section["closed"] is True
    assert section["spacing_mm"] == 3.0
    assert section["vertices"] == len(bust.views)
    assert 0.5 < section["seen_share"] < 0.9
    assert sum(section["parts"].values()) == pytest.approx(1.0)


@pytest.mark.parametrize(("surface", "files"), [("head", {"head"}), ("bust", {"bust"}), ("both", {"head", "bust"})])
def test_surface_says_what_is_written(
    surface, files: set[str], result: Reconstruction, photographed, tmp_path: Path
) -> None:
    requested = replace(SETTINGS, outputs=OutputSettings(surface=surface))
    made = replace(result, settings=requested, bust=None if surface == "head" else result.bust)
    write_result(tmp_path, made, photographed[1])
    assert {path.stem for path in tmp_path.glob("*.ply")} == files
    assert {path.stem for path in tmp_path.glob("*.glb")} == files


def test_a_head_is_pushed_out_to_hair(result: Reconstruction, photographed, renderer: Renderer, tmp_path: Path) -> None:
    """The head is a ball of 57 mm, the bust one of 60 mm whose upper half is hair; a ball has no texture layout."""
    bust, capture, silhouettes = photographed
    part = np.where(bust.mesh_world.vertices[:, 1] > 0.0, Part.HAIR, Part.SKIN).astype(np.uint8)
    bust = replace(bust, shaped=replace(bust.shaped, surface=replace(bust.surface, part=part)))
    sphere = trimesh.creation.icosphere(4, 57.0)
    head = Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32))
    refined = RefinedHead(head, np.ones(len(head.vertices)), Detail("photo", verbatim("planted")))
    settings = replace(SETTINGS, outputs=OutputSettings(surface="hair", formats=("ply",)))
    context = ReconstructionContext(capture, pinhole_fan(), load_model(), settings, renderer)
    views = Views(capture, silhouettes, {})
    staged = push_out_hair(context, views, refined, bust, context.capture)
    assert staged.product is not None
    assert list(staged.warnings) == []
    assert push_out_hair(replace(context, settings=SETTINGS), views, refined, bust, context.capture).product is None
    made = made_up_result(head, result.head.fit, settings=settings, bust=bust, hair=staged.product)
    write_result(tmp_path, made, capture)
    assert {path.stem for path in tmp_path.glob("*.ply")} == {"head", "bust", "head_hair"}
    written, height = read_head_ply(tmp_path / "head_hair.ply")
    np.testing.assert_array_equal(written.faces, head.faces)
    up = head.vertices[:, 1] > 15.0
    assert np.median(np.linalg.norm(written.vertices[up], axis=1)) == pytest.approx(60.0, abs=0.5)
    assert np.median(height[up]) == pytest.approx(3.0, abs=0.5)
    section = json.loads((tmp_path / "report.json").read_text())["hair"]
    assert section["covered_share"] > 0.95
