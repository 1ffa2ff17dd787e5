"""Faults of random heads and of a result's head.ply are counted; a folder without one is refused."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.errors import InputError
from rig.formats.meshes.ply import write_ply
from rig.mesh import Mesh
from tests.laboratory.experiments.records import Bench
from tests.laboratory.experiments.surface.meshes import meshes
from tests.support.subdivided_spheres import subdivided_sphere


def test_a_planted_fault_of_a_result_is_counted(tmp_path: Path) -> None:
    vertices, faces, _ = subdivided_sphere()
    pierced = vertices.copy()
    pierced[0] *= -1.1  # through the other side: so do the triangles at it
    mesh, count = Mesh(pierced, faces), len(pierced)
    (tmp_path / "planted").mkdir()
    write_ply(
        tmp_path / "planted" / "head.ply",
        mesh,
        normals=mesh.normals(),
        colours=np.full((count, 3), 128, np.uint8),
        quality=np.ones(count, np.float32),
        views=np.ones(count, np.uint8),
    )
    found = meshes({}, [tmp_path / "planted"], bench=Bench())
    degree = int((faces == 0).any(axis=1).sum())
    assert degree < found["figures"]["planted_crossing_after"] < 10 * degree
    assert found.get("markdown", "").splitlines()[2].startswith("| planted | 1 | - | - | - |")


@pytest.mark.slow
def test_random_heads_come_out_clean(tmp_path: Path) -> None:
    found = meshes({"default": load_model()}, [], bench=Bench(folder=tmp_path), subjects=1)
    for kind in ("fitted", "displaced"):
        of = f"default, {kind}_"
        figures = {name.removeprefix(of): value for name, value in found["figures"].items() if name.startswith(of)}
        assert figures["crossing_before"] > 0
        assert figures["turned_after"] == figures["folded_after"] == figures["crossing_after"] == 0
        assert 0.0 < figures["moved_share"] < 0.5
    assert (tmp_path / "meshes.json").is_file()


def test_a_folder_without_a_head_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no head\.ply"):
        meshes({}, [tmp_path], bench=Bench())
