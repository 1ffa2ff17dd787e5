from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.fusion.fusion import fuse
from pipeline.fusion.hair import OFF_HEAD_MM, STUBBLE_MM, parts_over_head, smooth_hair
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes, vote_parts
from pipeline.stereo.window_bias import WindowBias
from rig.mesh import Mesh
from rig.progress import discard_progress
from tests.support.ellipsoid_depths import Ellipsoid, scene
from tests.support.scenes import fan

RADIUS_MM = 60.0


def ball(radius_mm: float = RADIUS_MM) -> Mesh:
    sphere = trimesh.creation.icosphere(5, radius_mm)
    return Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32))


def votes_at(height_mm: float, part: Part) -> PartVotes:
    """Returns cells at a height over the ball that all show one part."""
    places = ball(RADIUS_MM + height_mm).vertices[::20]
    probability = np.zeros((len(places), 3))
    probability[:, part.channel] = 1.0
    return PartVotes(places.min(axis=0), np.array([40, 40, 40]), np.arange(len(places)), places, probability)


@pytest.mark.parametrize(
    ("height_mm", "shown", "part"),
    [
        (0.5 * STUBBLE_MM[0], Part.HAIR, Part.SKIN),
        (STUBBLE_MM[1] + 1.0, Part.HAIR, Part.HAIR),
        (STUBBLE_MM[1] + 1.0, Part.SKIN, Part.SKIN),
        (OFF_HEAD_MM + 1.0, Part.SKIN, Part.HAIR),
        (0.5 * STUBBLE_MM[0], Part.CLOTHES, Part.CLOTHES),
    ],
)
def test_height_over_the_head_decides_between_skin_and_hair(height_mm: float, shown: Part, part: Part) -> None:
    shares = parts_over_head(votes_at(height_mm, shown), ball()).probability
    assert (shares[:, part.channel] > 0.99).all()
    assert shares.sum(axis=1) == pytest.approx(1.0)


def test_scatter_of_strands_is_smoothed_and_skin_stays() -> None:
    rng, mesh = np.random.default_rng(0), ball()
    noisy = Mesh(mesh.vertices * (1.0 + rng.normal(0.0, 1.0 / RADIUS_MM, (len(mesh.vertices), 1))), mesh.faces)
    skin = (mesh.vertices[:, 0] > 0.0).astype(float)
    smooth = smooth_hair(noisy, skin, np.ones(len(skin), bool))
    off = np.linalg.norm(smooth.vertices, axis=1) - RADIUS_MM
    hair = mesh.vertices[:, 0] < -20.0
    assert (
        off[hair].std() < 0.25
    )  # of 1 mm; the 45 vertices about one leave a seventh, and neighbours that are weighed more a bit more
    assert np.median(off[hair]) == pytest.approx(0.0, abs=0.5)
    far = mesh.vertices[:, 0] > 20.0
    assert smooth.vertices[far] == pytest.approx(noisy.vertices[far], abs=0.05)


def test_votes_for_strands_leave_no_gravel() -> None:
    rng, exact = (
        np.random.default_rng(0),
        scene([Ellipsoid((0, 0, 0), (RADIUS_MM, RADIUS_MM, RADIUS_MM))], fan(400, 300)),
    )
    scattered = [
        replace(each, depth_mm=np.where(each.known, each.depth_mm + rng.normal(0.0, 4.0, each.depth_mm.shape), 0.0))
        for each in exact.maps
    ]
    handles = {}
    for part in (Part.SKIN, Part.HAIR):
        labels = {}
        for name, silhouette in exact.silhouettes.items():
            labels[name] = PartMap(name, np.zeros((*silhouette.mask.shape, 3), np.uint8))
            labels[name].of_255[..., part.channel] = 255
        surface = fuse(
            scattered,
            exact.silhouettes,
            exact.rig,
            None,
            bias=WindowBias(),
            spacing_mm=1.5,
            report=discard_progress,
            parts=vote_parts(scattered, labels, exact.rig),
        )
        mesh = surface.mesh_world
        handles[part] = 1 - (len(mesh.vertices) - len(mesh.faces) // 2) // 2
    assert handles[Part.SKIN] > 20
    assert handles[Part.HAIR] <= 2
