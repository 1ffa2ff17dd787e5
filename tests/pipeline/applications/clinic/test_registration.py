"""A head finds its place on a patient's surface, whose place is known."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.applications.clinic.anatomical_frame import frankfurt_axes
from pipeline.applications.clinic.patient_files import write_registration
from pipeline.applications.clinic.registration import PatientSurface, read_surface, read_surface_landmarks, register
from pipeline.applications.verification.reference import Reference
from rig.errors import InputError
from rig.formats.meshes.markups import Axes, MarkupPoint, markups_document
from rig.geometry import RigidTransform
from rig.mesh import Mesh
from tests.support.measured_heads import mannequin
from tests.support.visits import visit

HEAD = visit(name="anna")
ALLOWED_MM = 0.4  # three of the deviations that the fit states of 900 coarse vertices, 80 mm from their middle
LYING = Rotation.from_euler("xzy", (16.0, -22.0, 6.0), degrees=True).as_matrix()


def true_motion(axes: Axes) -> RigidTransform:
    upright = frankfurt_axes(HEAD.measured, axes).patient_from_world
    return RigidTransform(LYING, np.array([-30.0, 120.0, -700.0])) @ upright


def skin(axes: Axes) -> Mesh:
    """What a CBCT shows: the head from the brows down, 0.2 mm noise, a swollen cheek, and inside it a skull's surface
    that faces the other way."""
    head, rng = mannequin(), np.random.default_rng(2)
    cheek = head.vertices[HEAD.measured.mesh_world.vertices.argmax(axis=0)[0]]
    away = np.linalg.norm(head.vertices - cheek, axis=1)
    grown = (
        head.vertices
        + (5.0 * np.exp(-((away / 20.0) ** 2)) + 0.2 * rng.standard_normal(len(away)))[:, None] * head.normals()
    )
    inner = head.vertices - 6.0 * head.normals()
    vertices = np.concatenate([grown, inner])
    faces = np.concatenate([head.faces, head.faces[:, ::-1] + len(grown)])
    seen = np.tile(head.vertices[:, 1] < 45.0, 2)[faces].all(axis=1)
    used, corners = np.unique(faces[seen], return_inverse=True)
    world = HEAD.measured.head_from_world.inverse().apply(vertices[used])
    return Mesh(true_motion(axes).apply(world), corners.reshape(-1, 3).astype(np.int32))


def off_mm(found: RigidTransform, truth: RigidTransform) -> float:
    """How far the face is from where it belongs, at most."""
    face = HEAD.measured.mesh_world.vertices[HEAD.measured.regions["face"]]
    return float(np.linalg.norm(found.apply(face) - truth.apply(face), axis=1).max())


@pytest.mark.parametrize("axes", ["LPS", "RAS"])
def test_the_face_is_found_on_a_swollen_cut_skin_with_a_skull_in_it(axes: Axes) -> None:
    surface = PatientSurface(Reference.of(skin(axes), {}, "ct.stl"), axes, True)
    found = register(HEAD, surface)
    assert found.start == "frankfurt"
    assert off_mm(found.fit.motion, true_motion(axes)) < ALLOWED_MM
    figures = found.figures()
    assert 0.05 < figures["kept_std_mm"] < 0.3  # what was planted: 0.2 mm
    assert figures["p95_mm"] > 0.4  # the cheek, which took no part
    assert np.nanmax(np.abs(found.distance_mm)) > 3.0


def test_files_of_slicer_lead_there_and_back(tmp_path: Path) -> None:
    mesh = skin("RAS")
    data = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="stl")
    assert isinstance(data, bytes)
    path = tmp_path / "ct.stl"
    path.write_bytes(b"3D Slicer output. SPACE=RAS".ljust(80) + data[80:])
    surface = read_surface(path)
    assert (surface.axes, surface.stated) == ("RAS", True)
    truth = true_motion("RAS")
    names = ("pronasale", "cheilion_left", "tragion_right", "gnathion")
    rng = np.random.default_rng(5)
    points = {n.title(): MarkupPoint((truth.apply(HEAD.measured.landmarks[n]) + rng.normal(0.0, 3.0, 3)) * (-1, -1, 1))
              for n in names}  # fmt: skip
    marks = tmp_path / "marks.mrk.json"
    marks.write_text(json.dumps(markups_document(points, "LPS")))
    found = register(HEAD, surface, read_surface_landmarks(marks, surface.axes))
    assert found.start == "landmarks"
    assert off_mm(found.fit.motion, truth) < ALLOWED_MM
    document = write_registration(tmp_path / "out", found)
    matrix = np.array(document["patient_from_world"])
    moved = HEAD.measured.mesh_world.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    written = trimesh.load(tmp_path / "out" / "head.ply", process=False)
    assert isinstance(written, trimesh.Trimesh)
    np.testing.assert_allclose(written.vertices, moved, atol=1e-4)
    assert b"comment SPACE=RAS" in (tmp_path / "out" / "residual.ply").read_bytes()[:200]
    assert json.loads((tmp_path / "out" / "registration.json").read_text())["surface"]["axes"] == "RAS"


def test_another_surface_is_refused() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=95.0)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    surface = PatientSurface(Reference.of(mesh, {}, "b.stl"), "LPS", True)
    upright = frankfurt_axes(HEAD.measured, "LPS").patient_from_world
    names = ("pronasale", "tragion_left", "tragion_right")
    with pytest.raises(InputError, match=r"b\.stl: the surface does not have the face of anna"):
        register(HEAD, surface, {name: upright.apply(HEAD.measured.landmarks[name]) for name in names})


def test_too_few_landmarks_and_a_mesh_of_another_ending_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "two.mrk.json"
    path.write_text(json.dumps(markups_document({"pronasale": MarkupPoint(np.zeros(3))}, "LPS")))
    with pytest.raises(InputError, match="names 1 of the 26 landmarks; at least 3"):
        read_surface_landmarks(path, "LPS")
    (tmp_path / "ct.vtk").write_bytes(b"")
    with pytest.raises(InputError, match=r"\.stl"):
        read_surface(tmp_path / "ct.vtk")
