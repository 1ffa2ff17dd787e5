"""Patches of a head in photographs of a planted one."""

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.detail.patch_points import PatchSearch, prepare_patch_search
from rig.geometry import Similarity
from rig.mesh import vertex_normals
from tests.support.photo_scene import Scene, ellipsoid_model, fine_waves, photograph


@pytest.fixture(scope="module")
def scene() -> Scene:
    model = ellipsoid_model()
    return photograph(model, model.vertices(np.zeros(0)), fine_waves)


def search(scene: Scene, hair: float = 0.0) -> PatchSearch:
    fit = Fit("contour", np.zeros(0), Similarity.identity(), 1, "planted")
    distances = {name: silhouette.distance for name, silhouette in scene.silhouettes.items()}
    shown = {name: np.full(image.shape[:2], hair, np.float32) for name, image in scene.images.items()}
    return prepare_patch_search(scene.model, fit, scene.images, distances, shown, scene.rig)


@pytest.mark.parametrize("off_mm", [0.0, 0.4])
def test_patches_say_how_far_the_head_is_off(scene: Scene, off_mm: float) -> None:
    faces = scene.model.levels["full"].faces
    found = search(scene).measure(scene.truth + off_mm * vertex_normals(scene.truth, faces))
    # Matched to 0.1 px, 0.9 mm each, between views 25 degrees apart, five of them: 0.1 mm a patch.
    assert len(found.vertex) > 200
    assert np.median(found.distance_mm) == pytest.approx(-off_mm, abs=0.06)
    assert np.median(np.abs(found.distance_mm + off_mm)) < 0.15
    assert (found.information > 0).all()


def test_patches_of_hair_say_nothing(scene: Scene) -> None:
    assert not len(search(scene, hair=1.0).measure(scene.truth).vertex)
