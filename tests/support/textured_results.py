"""A result with a texture and nothing that was reconstructed."""

import numpy as np

from pipeline.fitting.fit import Fit
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import Settings
from pipeline.texture.uv_unwrap import Atlas
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh

PLACE = Similarity(1.0, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))


def textured_result(head: Mesh, atlas: Atlas) -> Reconstruction:
    """``head`` (head frame, mm) standing at ``PLACE``."""
    world = Mesh(PLACE.apply(head.vertices), head.faces)
    count = len(head.vertices)
    return Reconstruction(
        fit=Fit("contour", np.zeros(2), PLACE, 1, "it was made up"),
        model_name="mean",
        model_sha256="ab" * 32,
        mesh_world=world,
        normals=world.normals(),
        colours=np.full((count, 3), 120, np.uint8),
        views=np.ones(count, np.uint8),
        quality_mm=np.ones(count),
        silhouettes={},
        start_masks={},
        fitted_masks={},
        cameras={},
        landmarks={},
        measurements={},
        front="cam00",
        settings=Settings(),
        digests={"images/cam00.png": "cd" * 32},
        seconds={},
        atlas=atlas,
    )
