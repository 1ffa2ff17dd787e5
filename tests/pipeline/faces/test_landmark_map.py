"""Maps from the finder's points to models: measured ones where the model is built in, carried ones else."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.applications.model_building.sources.imports import import_model
from pipeline.faces.landmark_map import CARRIED_MM, LandmarkMap, NoLandmarkMap, built_in_map, faces_digest, landmark_map
from pipeline.faces.points import point_table
from pipeline.head_model.model import HeadModel, assemble, load_model
from pipeline.head_model.model_file import read_parts
from pipeline.head_model.model_names import model_path
from tests.support.shared_data import shared

NAMED = {  # points that lie on a landmark of the model, or a few millimetres from it
    33: "exocanthion_right", 263: "exocanthion_left", 133: "endocanthion_right", 362: "endocanthion_left",
    61: "cheilion_right", 291: "cheilion_left", 1: "pronasale", 2: "subnasale", 168: "nasion",
}  # fmt: skip
NEAR_MM = 9.0  # the finder's tip of the nose lies that far below the most forward point


@pytest.fixture(scope="module")
def of_model(model: HeadModel) -> LandmarkMap:
    return landmark_map(model)


def test_the_shipped_map_is_measured_and_its_jaw_and_forehead_slide(model: HeadModel, of_model: LandmarkMap) -> None:
    assert (of_model.rows == built_in_map("makehuman").rows).all()
    np.testing.assert_allclose(of_model.weights.sum(axis=1), 1.0, atol=1e-9)
    assert of_model.weights.min() > -1e-6
    assert not of_model.rows.flags.writeable
    assert not of_model.slides[[33, 133, 362, 263, 1, 168, 61, 291]].any()
    jaw = [172, 136, 150, 149, 176, 148, 377, 400, 378, 379, 365, 397]
    assert of_model.slides[jaw].mean() > 0.5
    assert of_model.slides.mean() < 0.4


def test_points_lie_on_landmarks_are_alike_and_move_with_the_head(model: HeadModel, of_model: LandmarkMap) -> None:
    head = model.vertices(np.zeros(0))
    points = of_model.points(head)
    for index, name in NAMED.items():
        assert np.linalg.norm(points[index] - head[model.landmarks[name]]) < NEAR_MM, name
    mirrored = points[point_table().mirror_images] * (-1.0, 1.0, 1.0)
    # The mean head's own halves, and triangles that are not each other's mirror image, leave some of a millimetre.
    assert np.median(np.linalg.norm(points - mirrored, axis=1)) < 0.5
    head = model.vertices(np.array([1.0, -0.5, 2.0]))
    np.testing.assert_allclose(of_model.points(2.0 * head + 5.0), 2.0 * of_model.points(head) + 5.0)
    np.testing.assert_allclose(of_model.expected(head), of_model.points(head) + of_model.offset_mm)


def test_covariance_adds_what_is_shared_to_what_is_not(of_model: LandmarkMap) -> None:
    which = np.array([1, 33, 263, 61])
    covariance = of_model.covariance(which)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    per_axis = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    assert (per_axis > 0.5).all()
    assert (per_axis < 5.0).all()
    eyes = of_model.covariance(np.array([33, 263]))
    assert eyes[2, 5] > 0.0  # the eyes' depths err together


def test_a_model_of_another_topology_gets_the_points_carried(of_model: LandmarkMap) -> None:
    """The shipped head with its cage's vertices in another order, so that its triangles are not known."""
    parts, _ = read_parts(model_path("default"))
    order = np.random.default_rng(3).permutation(len(parts.mean))
    place = np.argsort(order)
    other = assemble(
        replace(
            parts,
            mean=parts.mean[order],
            modes=parts.modes[:2, order],
            sigma=parts.sigma[:2],
            scores=parts.scores[:, :2],
            faces=place[parts.faces],
            face_region=parts.face_region[order],
            landmarks={name: int(place[row]) for name, row in parts.landmarks.items()},
            decimated={name: (parts.decimated[name][0][:4], np.array([[0, 1, 2]])) for name in parts.decimated},
            expressions=None,
        ),
        "another",
    )
    assert faces_digest(other) != faces_digest(load_model())
    carried = landmark_map(other)
    head = other.vertices(np.zeros(0))
    known = of_model.points(load_model().vertices(np.zeros(0)))
    # The very same head: nothing is lost on the way but that points lie on its surface.
    assert np.linalg.norm(carried.points(head) - known, axis=1).max() < 0.1
    np.testing.assert_allclose(carried.deviation_mm, np.hypot(of_model.deviation_mm, CARRIED_MM))
    assert (carried.slides == of_model.slides).mean() > 0.95


def test_a_model_without_landmarks_is_refused(model: HeadModel) -> None:
    full = model.levels["full"]
    few = {name: row for name, row in list(full.landmarks.items())[:4]}
    bare = replace(
        model, name="bare", levels={**model.levels, "full": replace(full, faces=full.faces[::-1], landmarks=few)}
    )
    with pytest.raises(NoLandmarkMap, match="head model bare: it names 4 of the 26 landmarks, and 6 are needed"):
        landmark_map(bare)


@pytest.mark.slow
def test_ict_facekit_has_a_measured_map_and_carrying_errs_as_stated() -> None:
    ict = assemble(import_model(shared("data/ict-facekit/ict_facekit_light.npz")), "")
    measured = landmark_map(ict)
    assert (measured.rows == built_in_map("ict-facekit").rows).all()
    full = ict.levels["full"]
    renumbered = replace(ict, levels={**ict.levels, "full": replace(full, faces=full.faces[::-1])})
    carried = landmark_map(renumbered)
    head = ict.vertices(np.zeros(0))
    miss = carried.points(head) - measured.points(head)
    assert 0.7 * CARRIED_MM < np.sqrt((miss**2).mean()) < 1.3 * CARRIED_MM
