"""What is scored of a bust: only what it calls seen, and how far the head lies off it."""

import numpy as np
import pytest

from pipeline.fusion.fusion import BustSurface
from rig.capture import Capture
from rig.mesh import Mesh, face_normals
from rig.rig import Rig
from rig.studio.scene.subject import HAIRSTYLES
from rig.studio.scene.visible import VisiblePoints
from tests.laboratory.experiments.paper.detail import Known
from tests.laboratory.experiments.surface.visible import (
    MIN_PLACES,
    STYLES,
    head_to_bust,
    region_errors,
    seen_of,
    splats,
)
from tests.support.scenes import ellipsoid

OFF_MM = 0.7


def planted() -> tuple[Mesh, BustSurface]:
    """A head whose bust lies off it all over, and of which only the front is seen."""
    head = ellipsoid(4)
    front = head.vertices[:, 2] > 0.0
    off = Mesh(head.vertices + OFF_MM * head.normals(), head.faces)
    views = np.where(front, 3, 0).astype(np.uint8)
    return head, BustSurface(off, np.ones(len(front)), (views > 0).astype(np.uint8), views)


def test_only_what_a_photograph_measures_counts_as_seen() -> None:
    _, bust = planted()
    seen = seen_of(bust)
    assert 0.4 < len(seen.faces) / len(bust.mesh_world.faces) < 0.6
    assert (seen.vertices[seen.faces][:, :, 2] > 0.0).all()


def test_the_head_is_compared_with_seen_skin() -> None:
    head, bust = planted()
    assert np.median(head_to_bust(head, bust)) == pytest.approx(OFF_MM, abs=0.05)


def test_errors_of_a_region_are_of_its_seen_skin_alone() -> None:
    """A truth 0.4 mm off the head in front and 2 mm behind, where nobody looks."""
    head = ellipsoid(4)
    front = head.vertices[:, 2] > 0.0
    true = Mesh(head.vertices + np.where(front, 0.4, 2.0)[:, None] * head.normals(), head.faces)
    count = int(front.sum())
    points = VisiblePoints(
        true.vertices[front].astype(np.float32), head.normals()[front].astype(np.float32),
        np.zeros(count, np.uint8), np.full(count, 2, np.uint8),
    )  # fmt: skip
    known = Known("planted", Capture({}), Rig(()), true, front, points)
    left = head.vertices[:, 0] > 0.0
    found = region_errors(known, head, {"eyes": left, "ears": ~left, "neck": left, "nose": np.zeros(len(left), bool)})
    assert set(found) == {f"head_{r}_seen_{q}_mm" for r in ("eyes", "ears") for q in ("median", "mean", "p95")}
    assert found["head_eyes_seen_median_mm"] == pytest.approx(0.4, abs=0.03)
    assert found["head_ears_seen_p95_mm"] < 0.6
    assert count > MIN_PLACES


def test_a_splat_faces_the_way_of_its_point() -> None:
    head = ellipsoid(3)
    normals = head.normals().astype(np.float32)
    count = len(normals)
    points = VisiblePoints(
        head.vertices.astype(np.float32), normals, np.zeros(count, np.uint8), np.ones(count, np.uint8)
    )
    drawn = splats(points)
    turned = face_normals(drawn.vertices, drawn.faces)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    assert np.allclose(turned, np.concatenate([normals, normals]), atol=1e-4)
    assert np.allclose(drawn.vertices.reshape(count, 4, 3).mean(axis=1), points.points, atol=1e-4)


def test_every_hairstyle_of_the_studio_has_its_turn() -> None:
    tight = {"swim-cap", "wig-cap"}  # nothing of the hair is seen below them; ``capped`` measures those
    assert {name for style in STYLES for name in style.split(",")} == HAIRSTYLES.keys() - tight
