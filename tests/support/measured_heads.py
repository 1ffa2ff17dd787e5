"""A head as verification measures it: the default model's coarse level, so that tests are quick."""

from functools import lru_cache

import numpy as np

from pipeline.applications.verification.measured import Measured
from pipeline.head_model.model import load_model
from pipeline.head_model.regions import head_regions
from pipeline.head_model.subdivision import vertex_areas
from rig.geometry import RigidTransform, rotation_from_vector
from rig.mesh import Mesh

LEVEL = "p95"
WORLD_FROM_HEAD = RigidTransform(rotation_from_vector(np.array([0.1, 0.2, -0.05])), np.array([12.0, -7.0, 30.0]))


model = lru_cache(maxsize=1)(load_model)


@lru_cache(maxsize=1)
def mannequin() -> Mesh:
    """Head frame, mm; 2,654 vertices or so."""
    coefficients = 0.8 * np.random.default_rng(5).standard_normal(60)
    return Mesh(model().vertices(coefficients, LEVEL), model().levels[LEVEL].faces)


def marks() -> dict[str, np.ndarray]:
    return {name: mannequin().vertices[row] for name, row in model().levels[LEVEL].landmarks.items()}


def measured_head(vertices: np.ndarray | None = None, name: str = "shot") -> Measured:
    """The mannequin (or another head of its vertices, head frame) where it sat, stated as good to 0.1 mm."""
    rows = model().levels[LEVEL].rows
    head = mannequin().vertices if vertices is None else vertices
    world = WORLD_FROM_HEAD.apply(head)
    found = {mark: world[row] for mark, row in model().levels[LEVEL].landmarks.items()}
    mesh = Mesh(world, mannequin().faces)
    regions = {region: mask[rows] for region, mask in head_regions(model()).items()}
    stated, areas = np.full(len(world), 0.1), vertex_areas(world, mesh.faces)
    return Measured(name, mesh, stated, areas, regions, found, WORLD_FROM_HEAD.inverse())
