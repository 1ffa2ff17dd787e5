"""Damaged references are named before anything is judged by them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.verification.reference import Reference, read_reference
from rig.errors import InputError
from rig.formats.meshes.ply import ply_bytes
from rig.mesh import Mesh
from tests.support.glb import obj_bytes
from tests.support.landmark_files import write_landmarks
from tests.support.measured_heads import mannequin, marks


def refused(mesh: Mesh, landmarks: dict[str, np.ndarray] | None = None) -> str:
    with pytest.raises(InputError) as error:
        Reference.of(mesh, landmarks or {}, "scan.ply")
    return str(error.value)


def coloured(mesh: Mesh) -> bytes:
    count = len(mesh.vertices)
    grey = np.full((count, 3), 128, np.uint8)
    return ply_bytes(
        mesh, normals=mesh.normals(), colours=grey, quality=np.zeros(count, np.float32), views=np.zeros(count, np.uint8)
    )


def test_a_scan_is_read_with_the_landmarks_beside_it(tmp_path: Path) -> None:
    (tmp_path / "scan.ply").write_bytes(coloured(mannequin()))
    write_landmarks(tmp_path / "scan.json", marks())
    found = read_reference(tmp_path / "scan.ply")
    assert found.landmarks.keys() == marks().keys()
    assert (found.name, len(found.sha256)) == ("scan.ply", 64)
    write_landmarks(tmp_path / "seven.json", {"pronasale": marks()["pronasale"]})
    assert read_reference(tmp_path / "scan.ply", tmp_path / "seven.json").landmarks.keys() == {"pronasale"}


def test_half_an_obj_is_named(tmp_path: Path) -> None:
    data = obj_bytes(replace(mannequin(), colours=np.full((len(mannequin().vertices), 3), 128, np.uint8)))
    start = data.index(b"\nf ")
    (tmp_path / "scan.obj").write_bytes(data[: data.index(b"\n", start + 900) + 1])
    with pytest.raises(InputError, match="is the file whole"):
        read_reference(tmp_path / "scan.obj")


def test_units_triangles_that_face_different_ways_and_landmarks_of_another_frame_are_named() -> None:
    assert "which is a head in m: scale it to mm" in refused(replace(mannequin(), vertices=mannequin().vertices / 1000))
    assert "which is a head in cm" in refused(replace(mannequin(), vertices=mannequin().vertices / 10))
    assert "scale it to mm" in refused(replace(mannequin(), vertices=mannequin().vertices * 1000))
    faces = mannequin().faces.copy()
    faces[::3] = faces[::3, ::-1]
    assert "face opposite ways" in refused(Mesh(mannequin().vertices, faces))
    moved = {name: point + (0.0, 0.0, 50.0) for name, point in marks().items()}
    refusal = refused(replace(mannequin(), vertices=mannequin().vertices / 10), moved)
    assert "landmarks off the surface: " in refusal
    assert "in cm" in refusal


def test_closest_points_at_the_rim_are_known() -> None:
    kept = mannequin().vertices[mannequin().faces].mean(axis=1)[:, 0] > 0.0
    found = Reference.of(Mesh(mannequin().vertices, mannequin().faces[kept]), {})
    left, right = marks()["zygion_left"], marks()["zygion_right"]
    hits = found.index.closest(np.stack([left, right]))
    assert found.beside(hits).tolist() == [False, True]
