"""A head is laid on its scan wherever that lies, with landmarks or without; another mesh is refused."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.applications.verification.best_fit import align_face
from pipeline.applications.verification.reference import Reference
from rig.errors import InputError
from rig.geometry import RigidTransform, rotation_from_vector
from rig.mesh import Mesh
from tests.support.measured_heads import WORLD_FROM_HEAD, mannequin, marks, measured_head
from tests.support.scenes import ellipsoid

SOMEWHERE = RigidTransform(rotation_from_vector(np.array([1.2, -2.0, 0.7])), np.array([400.0, -90.0, 1500.0]))


def elsewhere(scale: float = 1.0) -> Mesh:
    return replace(mannequin(), vertices=SOMEWHERE.apply(scale * mannequin().vertices))


def test_landmarks_start_it_and_the_surface_ends_it() -> None:
    off = {name: SOMEWHERE.apply(point) + 2.0 for name, point in marks().items()}  # marked 3.5 mm aside
    fit = align_face(measured_head(), Reference.of(elsewhere(), off))
    truth = SOMEWHERE @ WORLD_FROM_HEAD.inverse()
    assert fit.start == "landmarks"
    assert fit.rms_mm < 1e-3
    assert fit.scale == pytest.approx(1.0, abs=3e-5)
    np.testing.assert_allclose(fit.reference_from_world.rotation, truth.rotation, atol=3e-5)
    np.testing.assert_allclose(fit.reference_from_world.translation, truth.translation, atol=3e-2)


@pytest.mark.slow
def test_a_search_finds_it_without_landmarks_on_a_pedestal() -> None:
    stand = ellipsoid(4)
    stand = replace(stand, vertices=0.9 * (stand.vertices - stand.vertices.mean(axis=0)) + (0.0, -240.0, 0.0))
    whole = np.concatenate([mannequin().vertices, stand.vertices])
    faces = np.concatenate([mannequin().faces, stand.faces + len(mannequin().vertices)])
    fit = align_face(measured_head(), Reference.of(Mesh(SOMEWHERE.apply(whole), faces), {}))
    assert fit.start == "search"
    assert fit.rms_mm < 1e-3


def test_a_size_is_reported_and_takes_no_part() -> None:
    """The reference is 1 % larger: the head is 1 / 1.01 of it, and what no motion takes away is left."""
    larger = {name: SOMEWHERE.apply(1.01 * point) for name, point in marks().items()}
    fit = align_face(measured_head(), Reference.of(elsewhere(1.01), larger))
    assert fit.scale == pytest.approx(1 / 1.01, abs=3e-5)
    assert 0.2 < fit.rms_mm < 1.0


def test_another_object_is_refused() -> None:
    ball = ellipsoid(4)
    poles = ball.vertices[np.argsort(ball.vertices[:, 1])[[0, 600, 1200]]]
    named: dict[str, np.ndarray] = dict(zip(["gnathion", "pronasale", "glabella"], poles, strict=True))
    with pytest.raises(InputError, match=r"ball\.ply: is no scan of the head in shot"):
        align_face(measured_head(), Reference.of(ball, named, "ball.ply"))
