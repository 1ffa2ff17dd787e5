"""Section 3.2 from scans to vertices: landmarks stay, holes are void, the refinement lies on the truth, the prior."""

import math
import pickle
from functools import partial

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from pipeline.applications.model_building.correspondence import correspondence as prior
from pipeline.applications.model_building.correspondence.correspondence import (
    FEW,
    CylinderIndex,
    Prior,
    _most_probable,
    common_frame,
    correspond,
    on_reference,
    prepared,
    warp_and_resample,
    workers,
)
from pipeline.applications.model_building.correspondence.scans import Scan
from pipeline.applications.model_building.training.figures import Scanner, scan_head
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.landmarks import NAMES, mirrored, stacked
from pipeline.head_model.model import HeadModel
from rig.geometry import RigidTransform
from rig.progress import discard_progress

SUBJECTS = (4, 40, 100)


def truth(model: HeadModel, subject: int) -> np.ndarray:
    return model.vertices(model.scores[subject].astype(float))


@pytest.fixture(scope="module")
def scans(model: HeadModel) -> list[Scan]:
    """No noise, so that what is found can be held against the surface itself."""
    scanner = Scanner(spacing_mm=2.5, noise_mm=0, landmark_noise_mm=0, holes=0)
    scan = partial(scan_head, faces=model.levels["full"].faces, landmarks=model.landmarks, scanner=scanner)
    return [scan(f"s{k}", truth(model, k), rng=np.random.default_rng(k)) for k in SUBJECTS]


@pytest.fixture(scope="module")
def papers(model: HeadModel, scans: list[Scan]) -> tuple[list[np.ndarray], np.ndarray]:
    """Samples of each scan in its own frame, by the paper's steps, and which of them are void."""
    frames, index = common_frame(scans, model), np.array([model.landmarks[name] for name in NAMES])
    shape, heads, voids = on_reference(prepared(scans[0], frames[0]), model), [], []
    for scan, frame in zip(scans, frames, strict=True):
        cylinder = CylinderIndex(frame.apply(scan.vertices), scan.faces)
        _, head, void = warp_and_resample(shape, index, frame.apply(stacked(scan.landmarks)), cylinder)
        heads.append(frame.inverse().apply(head))
        voids.append(void)
    return heads, np.array(voids)


def test_landmarks_stay_where_they_were_marked(model: HeadModel, scans: list[Scan], papers: tuple) -> None:
    index = [model.landmarks[name] for name in NAMES]
    for scan, head, void in zip(scans, *papers, strict=True):
        np.testing.assert_allclose(head[index], stacked(scan.landmarks), atol=1e-9)
        assert not void[index].any()


def test_what_is_not_void_lies_on_the_scan(scans: list[Scan], papers: tuple, model: HeadModel) -> None:
    """Samples are points of the scan's own triangles; landmarks alone may lie off them."""
    sampled = np.ones(len(model.mean), bool)
    sampled[[model.landmarks[name] for name in NAMES]] = False
    for scan, head, void in zip(scans, *papers, strict=True):
        some = np.flatnonzero(sampled & ~void)[::7]
        assert SurfaceIndex(scan.vertices, scan.faces).closest(head[some]).distances.max() < 0.05


def test_vertices_of_a_hole_are_void_and_those_of_the_cheek_are_not(model: HeadModel, papers: tuple) -> None:
    """The scanner loses what is behind the ears, in every scan."""
    places = model.vertices(np.zeros(0))[: len(model.mean)]
    lost = np.linalg.norm(places - (places[model.landmarks["tragion_left"]] + [0, 0, -18.0]), axis=1) < 6.0
    cheek = np.linalg.norm(places - places[model.landmarks["zygion_left"]], axis=1) < 15.0
    assert papers[1][:, lost].mean() > 0.8
    assert papers[1][:, cheek].mean() < 0.05


@pytest.mark.slow
def test_the_refinement_finds_the_true_vertices(model: HeadModel, scans: list[Scan]) -> None:
    """Without noise and with a prior that knows the heads, what remains is sliding on plain skin.

    Bound on the median: the scan's own step between samples (2.5 mm) places a vertex to 2.5 / sqrt(12) an axis of the
    surface, 1.0 mm in the plane. Normal to the surface only the facets' sag counts: 2.5^2 / (8 * 50 mm) = 0.02 mm.
    """
    found, use = correspond(scans, model, discard_progress), model.levels["cage"].face_region
    for k, scan, placed, frame in zip(SUBJECTS, scans, found, common_frame(scans, model), strict=True):
        head = frame.inverse().apply(placed)
        assert np.median(SurfaceIndex(scan.vertices, scan.faces).closest(head[use]).distances) < 0.1
        marks = truth(model, k)[[model.landmarks[name] for name in NAMES]]
        turn, shift = _motion(marks, stacked(scan.landmarks))
        wanted = (truth(model, k)[: len(model.mean)] @ turn.T + shift)[use]
        assert np.median(np.linalg.norm(head[use] - wanted, axis=1)) < 1.0


def _motion(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """scipy's own rigid fit, as a check on ours."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))[0]
    return rotation.as_matrix(), target.mean(0) - rotation.as_matrix() @ source.mean(0)


def test_localising_multiplies_the_covariance_by_a_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the product written out; a sketch as wide as the space leaves out nothing but rounding."""
    rng = np.random.default_rng(3)
    places, modes = rng.uniform(-80, 80, (50, 3)), rng.normal(0, 2, (4, 50, 3))
    monkeypatch.setattr(prior, "KEPT", 150)
    monkeypatch.setattr(prior, "_BLOCK", 16)
    found = prior.localised(places, modes.astype(np.float32)).reshape(-1, 150)
    plain = modes.reshape(4, -1)
    window = np.repeat(np.repeat(np.exp(-(cdist(places, places) ** 2) / (2 * prior.LENGTH_MM**2)), 3, 0), 3, 1)
    wanted = window * (plain.T @ plain)
    assert np.abs(found.T @ found - wanted).max() < 1e-3 * np.abs(wanted).max()


def test_the_mixture_keeps_each_vertex_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a mesh without two sides, so that nothing is mirrored."""
    rng = np.random.default_rng(4)
    places, modes = rng.uniform(-80, 80, (40, 3)), rng.normal(0, 2, (5, 40, 3))
    monkeypatch.setattr(prior, "KEPT", 120)
    mixed = prior.registration_prior(places, modes, rng.permutation(40)[:39].reshape(13, 3).astype(np.int32))
    assert mixed.broad == 5
    np.testing.assert_allclose((mixed.modes.astype(float) ** 2).sum(0), (modes**2).sum(0), rtol=1e-3)
    assert pytest.approx(1) == prior.GLOBAL**2 + prior.LOCAL**2


@pytest.mark.slow
def test_a_head_is_as_likely_as_its_mirror_image(model: HeadModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Landmarks' names say what lies opposite. The covariance of any two places is that of their mirror images."""
    monkeypatch.setattr(prior, "KEPT", 0)  # the localised part is a product of two symmetric ones
    faces, mean = model.levels["cage"].faces, model.mean.astype(float)
    opposite = prior.mirror_images(mean, faces)
    assert opposite is not None
    np.testing.assert_array_equal(opposite[opposite], np.arange(len(mean)))
    for name in NAMES:
        assert opposite[model.landmarks[name]] == model.landmarks[mirrored(name)]
    found = prior.registration_prior(mean, model.modes, faces)
    some = np.random.default_rng(0).choice(len(mean), 60, replace=False)
    here = found.modes[:, some].reshape(found.broad, -1).astype(float)
    there = (found.modes[:, opposite[some]] * [-1, 1, 1]).reshape(found.broad, -1).astype(float)
    np.testing.assert_allclose(there.T @ there, here.T @ here, atol=1e-4)
    np.testing.assert_allclose(found.mean[opposite] * [-1, 1, 1], found.mean, atol=1e-9)


def test_smoothing_a_scan_takes_noise_and_keeps_size(model: HeadModel) -> None:
    """White noise on a triangular grid falls as its spectrum says; a plain smoothing would move the skin inwards."""
    a, b = np.meshgrid(*[2 * np.pi * np.arange(64) / 64] * 2)
    roughness = 1 - (1 + 2 * np.cos(a) + 2 * np.cos(b) + 2 * np.cos(a + b)) / 7
    share = np.sqrt((((1 - 0.5 * roughness) * (1 + 0.53 * roughness)) ** 8).mean())
    faces, head = model.levels["full"].faces, model.vertices(np.zeros(0))
    scanner = Scanner(noise_mm=0.3, landmark_noise_mm=0, turn_rad=0, shift_mm=0, ear_holes=False, holes=0)
    scan = scan_head("s", head, faces, model.landmarks, scanner, np.random.default_rng(0))
    smooth = prepared(scan, RigidTransform.identity()).vertices
    brow = np.linalg.norm(scan.vertices - scan.landmarks["glabella"], axis=1) < 30
    skull = (scan.vertices[:, 1] > scan.landmarks["glabella"][1] + 40) & (scan.vertices[:, 2] < 0)
    for where in (brow, skull):
        some = np.flatnonzero(where)[::5]
        near = SurfaceIndex(head, faces).closest(smooth[some])
        off = np.einsum("nx,nx->n", smooth[some] - near.points, near.normals)
        assert off.std() < 1.1 * share * 0.3
        assert abs(off.mean()) < 0.02
    assert share < 0.6


def test_processes_give_what_one_gives_in_order_and_say_how_far_they_are() -> None:
    items = [float(k) for k in range(FEW + 3)]
    said: list[float] = []
    with workers(2, len(items)) as crew:
        assert crew.pool is not None
        assert crew.over(math.sqrt, items, "roots", lambda _, share: said.append(share)) == [k**0.5 for k in items]
        with pytest.raises(ValueError, match="domain"):
            crew.over(math.sqrt, [-1.0], "roots", discard_progress)
    assert said == [(k + 1) / len(items) for k in range(len(items))]
    with workers(2, FEW - 1) as crew:
        assert crew.pool is None


def test_what_processes_are_given_can_travel(model: HeadModel, scans: list[Scan]) -> None:
    """A scan, the template and the work on them, as processes receive them."""
    index, faces = np.array([model.landmarks[name] for name in NAMES]), model.levels["cage"].faces
    (frame,), mean = common_frame(scans[:1], model), model.vertices(np.zeros(0))[: len(model.mean)]
    work = partial(_most_probable, Prior(mean, model.modes[:2].astype(np.float32), 1), faces, index)
    again = pickle.loads(pickle.dumps(work))
    scan, template = pickle.loads(pickle.dumps((scans[0], model)))
    np.testing.assert_array_equal(again((scan, frame)), work((scans[0], frame)))
    np.testing.assert_array_equal(template.vertices(np.ones(3)), model.vertices(np.ones(3)))
