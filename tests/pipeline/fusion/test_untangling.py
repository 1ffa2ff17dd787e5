"""Spoilt triangles are found as a plain test of every pair finds them, and heads come out clean of them: planted folds,
sheets pushed through each other, random heads that make random faces under hostile displacements."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from pipeline.detail.smooth_field import smooth_field
from pipeline.detail.solve import solving_nodes
from pipeline.fusion.crossings import crossing_faces
from pipeline.fusion.untangling import (
    MeshFaults,
    clean_mean_head,
    head_topology,
    mesh_faults,
    spoilt_faces,
    topology_of,
    turned_faces,
    untangle,
    untangle_head,
)
from pipeline.head_model.gaussian_process import model_basis
from pipeline.head_model.model import HeadModel, load_model
from pipeline.settings import Settings
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import face_normals, vertex_normals
from tests.support.subdivided_spheres import subdivided_sphere

COARSE_SEEDS = 10
SEEDS_A_TEST = 10  # a slow test has five minutes, also beside others
EVERY_CHANGE = (2, 102)  # first seeds: twenty heads; the night has two hundred
EXPRESSIONS = 5  # at once, each up to its full weight
HOSTILE_MM, LENGTH_MM = 1.5, 5.0  # standard deviation of a displacement along the normals, twice what the fine stage
# takes for likely, and over which it fades, the fine stage's own

Displacement = Callable[[np.random.Generator], np.ndarray]


def test_turned_and_folded_triangles_are_those_that_a_plain_test_finds() -> None:
    vertices, faces, _ = subdivided_sphere()
    shaken = vertices + np.random.default_rng(0).normal(0.0, 0.8, vertices.shape)
    normals, mean = face_normals(shaken, faces), vertex_normals(shaken, faces)
    expected = (normals * mean[faces].mean(axis=1)).sum(axis=1) <= 0.0
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    at_edge: dict[tuple[int, int], int] = {}
    for f, (a, b, c) in enumerate(faces.tolist()):
        for edge in ((a, b), (b, c), (c, a)):
            key = (min(edge), max(edge))
            other = at_edge.setdefault(key, f)
            if other != f and unit[f] @ unit[other] < np.cos(np.radians(100.0)):
                expected[[f, other]] = True
    assert 20 < expected.sum() < len(faces) / 2
    topology = topology_of(faces, len(vertices))
    np.testing.assert_array_equal(turned_faces(shaken, topology), expected)
    chosen = np.zeros(len(faces), bool)
    chosen[1000:1400] = True
    found = turned_faces(shaken, topology, chosen)
    np.testing.assert_array_equal(found[chosen], expected[chosen])
    assert not found[~expected].any()


def test_a_clean_surface_is_left_as_it_is() -> None:
    vertices, faces, _ = subdivided_sphere()
    moved = vertices * (1.0 + 0.02 * np.sin(vertices[:, :1] / 20.0))
    np.testing.assert_array_equal(untangle(moved, topology_of(faces, len(moved))), moved)


def test_a_dent_that_comes_out_behind_is_taken_back_and_the_rest_stays() -> None:
    vertices, faces, _ = subdivided_sphere()
    away = np.linalg.norm(vertices[:, :2], axis=1)
    pushed = vertices.copy()
    top = (away < 12.0) & (vertices[:, 2] > 0)
    pushed[top] += (3.1, 1.7, -170.0)  # through the opposite side, 10 mm beyond it
    topology = topology_of(faces, len(pushed))
    assert crossing_faces(pushed, faces).sum() > 50
    clean = untangle(pushed, topology)
    assert not spoilt_faces(clean, topology).any()
    far = np.abs(vertices[:, 2]) < 40.0
    np.testing.assert_array_equal(clean[far], pushed[far])


def test_a_spot_gets_the_shape_at_rest_where_that_is_clean_and_is_flattened_without_one() -> None:
    vertices, faces, _ = subdivided_sphere()
    bump = np.exp(-((np.linalg.norm(vertices[:, :2], axis=1) / 20.0) ** 2)) * (vertices[:, 2] > 0)
    rest = vertices * (1.0 + 0.3 * bump)[:, None]
    place = Similarity(1.1, rotation_from_vector(np.array([0.3, -0.2, 0.5])), np.array([10.0, -700.0, 90.0]))
    moved, topology = place.apply(rest), topology_of(faces, len(rest))
    top = np.argsort(-bump)[:40]
    folded = moved.copy()
    folded[top] = np.random.default_rng(1).permutation(moved[top])
    assert spoilt_faces(folded, topology).any()
    clean, flat = untangle(folded, topology, rest), untangle(folded, topology)
    for result in (clean, flat):
        assert mesh_faults(result, topology) == MeshFaults(0, 0, 0)
    assert np.linalg.norm(clean - moved, axis=1).max() < 0.1
    assert np.linalg.norm(flat - moved, axis=1).max() > 1.0


@pytest.fixture(scope="module")
def wide_model() -> HeadModel:
    return model_basis(load_model(), Settings())  # eigenheads, kernel and expressions


@pytest.fixture(scope="module")
def hostile(wide_model: HeadModel) -> Displacement:
    """Draws smooth displacements along the normals (mm, full level) that know no surface."""
    mean, fine = wide_model.vertices(np.zeros(0)), solving_nodes(wide_model).fine
    field = smooth_field(fine.shape @ mean, fine.faces, LENGTH_MM)
    factor = splu(sparse.csc_array(field.operator), permc_spec="MMD_AT_PLUS_A")

    def draw(rng: np.random.Generator) -> np.ndarray:
        white = np.sqrt(field.mass / field.precision_scale) * rng.standard_normal(len(field.mass))
        return HOSTILE_MM * (fine.operator @ factor.solve(white))

    return draw


def random_face(model: HeadModel, rng: np.random.Generator) -> np.ndarray:
    coefficients = np.clip(rng.standard_normal(len(model.modes)), -2.5, 2.5)
    coefficients[model.posed] = 0.0
    coefficients[rng.choice(model.posed, EXPRESSIONS, replace=False)] = rng.uniform(0.0, 1.0, EXPRESSIONS)
    return coefficients


def check_clean(model: HeadModel, seed: int, hostile: Displacement) -> None:
    """A random head with a random face comes out clean; every other one under a displacement that knows no surface."""
    rng = np.random.default_rng(seed)
    vertices = model.vertices(random_face(model, rng))
    if seed % 2:
        vertices += hostile(rng)[:, None] * vertex_normals(vertices, model.levels["full"].faces)
    mesh, deviation_mm = untangle_head(model, vertices, np.full(len(vertices), 0.3))
    stored = mesh.vertices.astype(np.float32).astype(float)
    assert mesh_faults(stored, head_topology(model)) == MeshFaults(0, 0, 0), seed
    moved_mm = np.linalg.norm(mesh.vertices - vertices, axis=1)
    np.testing.assert_allclose(deviation_mm, np.sqrt(0.3**2 + moved_mm**2))
    assert (moved_mm == 0.0).mean() > 0.5, seed  # spots, not the head


def test_the_mean_head_and_a_few_random_ones_come_out_clean(wide_model: HeadModel, hostile: Displacement) -> None:
    topology = head_topology(wide_model)
    assert spoilt_faces(wide_model.vertices(np.zeros(0)), topology).any()  # its lips touch
    assert mesh_faults(clean_mean_head(wide_model), topology) == MeshFaults(0, 0, 0)
    for seed in (0, 1):
        check_clean(wide_model, seed, hostile)


def test_random_heads_and_expressions_come_out_clean_on_a_coarse_level(wide_model: HeadModel) -> None:
    level = wide_model.levels["p95"]
    topology = topology_of(level.faces, level.count)
    rest, spoilt = untangle(wide_model.vertices(np.zeros(0), "p95"), topology), 0
    for seed in range(COARSE_SEEDS):
        vertices = wide_model.vertices(random_face(wide_model, np.random.default_rng(seed)), "p95")
        clean = untangle(vertices, topology, rest)
        assert mesh_faults(clean.astype(np.float32).astype(float), topology) == MeshFaults(0, 0, 0), seed
        spoilt += spoilt_faces(vertices, topology).any()
    assert spoilt > COARSE_SEEDS / 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "first",
    [
        pytest.param(first, marks=[] if first in EVERY_CHANGE else pytest.mark.nightly)
        for first in range(2, 202, SEEDS_A_TEST)
    ],
)
def test_two_hundred_random_heads_come_out_clean(wide_model: HeadModel, hostile: Displacement, first: int) -> None:
    for seed in range(first, first + SEEDS_A_TEST):
        check_clean(wide_model, seed, hostile)
