"""What counts as seen of a surface, and what its deviation says."""

import numpy as np

from pipeline.fusion.refinement import MAX_MM, Measured, SeenVertices, deviation_mm, without_islands
from rig.mesh import Mesh
from tests.support.scenes import ellipsoid

HEAD = ellipsoid(4)  # edges of 8 mm: triangles of 30 mm2


def seen_where(mesh: Mesh, seen: np.ndarray) -> Measured:
    count = len(mesh.vertices)
    return Measured(np.zeros(count), np.where(seen, 25.0, 0.0), np.zeros(count), np.where(seen, 2, 0).astype(np.uint8))


def test_a_small_patch_with_nothing_seen_about_it_is_not_seen() -> None:
    front, behind = HEAD.vertices[:, 2] > 10.0, np.argmin(HEAD.vertices[:, 2])
    alone = np.zeros(len(front), bool)
    alone[HEAD.faces[(HEAD.faces == behind).any(axis=1)][:2]] = True  # two triangles
    kept = without_islands(HEAD, seen_where(HEAD, front | alone))
    np.testing.assert_array_equal(kept.views > 0, front)


def test_a_larger_patch_stays() -> None:
    back = HEAD.vertices[:, 2] < -85.0
    kept = without_islands(HEAD, seen_where(HEAD, back))
    np.testing.assert_array_equal(kept.views > 0, back)


def test_what_is_taken_off_has_the_deviation_of_a_guess() -> None:
    alone = np.zeros(len(HEAD.vertices), bool)
    alone[HEAD.faces[0]] = True
    before = seen_where(HEAD, alone)
    after = without_islands(HEAD, before)
    found = [deviation_mm(SeenVertices.of(HEAD.vertices, one.views > 0), one) for one in (before, after)]
    assert found[0][HEAD.faces[0]].max() < 1.0
    assert (found[1] == MAX_MM).all()
