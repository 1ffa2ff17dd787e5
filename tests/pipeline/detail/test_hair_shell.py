"""The head pushed out to its hair: on the hair, never inside the skin, and told where its vertices do not reach."""

import numpy as np
import pytest
import trimesh

from pipeline.detail.hair_shell import MIN_COVERED, covered_share, move_to_hair
from pipeline.part_labels.codes import Part
from rig.mesh import Mesh

HEAD_MM, HAIR_MM = 80.0, 95.0


def ball(radius: float, subdivisions: int = 4) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.asarray(made.vertices, float), np.asarray(made.faces, np.int32))


@pytest.fixture(scope="module")
def capped() -> tuple[Mesh, Mesh, np.ndarray]:
    """A ball as head, and a bust whose upper half stands 15 mm off it, with strands of 1.5 mm."""
    head, bust = ball(HEAD_MM), ball(1.0, 5)
    up = bust.vertices[:, 1]
    share = np.clip((up - 0.1) / 0.1, 0.0, 1.0)
    strands = 1.5 * share * np.sin(12.0 * bust.vertices[:, 0]) * np.sin(12.0 * bust.vertices[:, 2])
    radius = HEAD_MM + (HAIR_MM - HEAD_MM) * share + strands
    part = np.where(share > 0.0, Part.HAIR, Part.SKIN).astype(np.uint8)
    return head, Mesh(radius[:, None] * bust.vertices, bust.faces), part


def test_hair_is_covered_and_skin_stays(capped: tuple[Mesh, Mesh, np.ndarray]) -> None:
    head, bust, part = capped
    made = move_to_hair(head, bust, part)
    assert covered_share(head, bust, part) < 0.1
    assert made.covered > 0.98
    skin = head.vertices[:, 1] < -0.1 * HEAD_MM
    assert made.height_mm[skin].max() < 0.5
    top = head.vertices[:, 1] > 0.5 * HEAD_MM
    assert np.median(made.height_mm[top]) == pytest.approx(HAIR_MM - HEAD_MM, abs=1.0)


def test_no_vertex_lies_in_the_skin_and_a_head_without_hair_is_the_head(capped: tuple[Mesh, Mesh, np.ndarray]) -> None:
    head, bust, part = capped
    sunk = Mesh(bust.vertices * np.where(part == Part.HAIR, 1.0, 0.97)[:, None], bust.faces)
    made = move_to_hair(head, sunk, part)
    inner = HEAD_MM * np.cos(np.radians(2.5))  # the middle of the ball's triangles
    assert np.linalg.norm(made.vertices_world, axis=1).min() > inner
    bald = move_to_hair(head, bust, np.zeros_like(part))
    np.testing.assert_array_equal(bald.vertices_world, head.vertices)
    assert bald.covered == 1.0


def test_hair_that_hangs_beside_the_head_is_not_reached(capped: tuple[Mesh, Mesh, np.ndarray]) -> None:
    head, bust, part = capped
    curtain = trimesh.creation.box((4.0, 150.0, 100.0)).subdivide().subdivide().subdivide().subdivide()
    hanging = np.asarray(curtain.vertices) + (110.0, -120.0, 0.0)
    both = Mesh(np.concatenate([bust.vertices, hanging]), np.concatenate([bust.faces, curtain.faces + len(part)]))
    made = move_to_hair(head, both, np.concatenate([part, np.full(len(hanging), Part.HAIR, np.uint8)]))
    assert made.covered < MIN_COVERED
    assert np.linalg.norm(made.vertices_world, axis=1).max() < 1.1 * HAIR_MM
