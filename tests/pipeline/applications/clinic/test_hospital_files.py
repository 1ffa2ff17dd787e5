"""A head as DICOM and NIfTI, read back by the libraries that hospitals' programs use."""

import io
import json
from pathlib import Path

import numpy as np
import pydicom
import pytest
import trimesh
from nibabel.nifti1 import Nifti1Image
from nibabel.orientations import aff2axcodes
from scipy.ndimage import map_coordinates

from pipeline.applications.clinic.anatomical_frame import frankfurt_axes
from pipeline.applications.clinic.hospital_files import dicom_bytes, fill_voxels, write_hospital_files
from rig.mesh import Mesh
from tests.support.visits import moved, visit

HERE = visit(name="Anna Example")


def test_the_object_holds_a_closed_head_in_the_patient_s_axes_and_no_name(tmp_path: Path) -> None:
    frame = frankfurt_axes(HERE.measured, "LPS")
    write_hospital_files(tmp_path, HERE, frame, "dicom", "P017")
    data = (tmp_path / "head.dcm").read_bytes()
    assert b"Anna" not in data + (tmp_path / "frame.json").read_bytes()
    held = pydicom.dcmread(io.BytesIO(data))
    assert (held.SOPClassUID.name, held.MIMETypeOfEncapsulatedDocument) == ("Encapsulated STL Storage", "model/stl")
    assert (held.PatientID, held.StudyDate, held.RecognizableVisualFeatures) == ("P017", "", "YES")
    surface = trimesh.load(io.BytesIO(held.EncapsulatedDocument[: held.EncapsulatedDocumentLength]), file_type="stl")
    assert isinstance(surface, trimesh.Trimesh)
    assert surface.is_watertight
    assert surface.volume > 1e6  # outwards, mm
    nose = frame.patient_from_world.apply(HERE.measured.landmarks["pronasale"])
    assert nose[1] < surface.vertices[:, 1].mean() - 50.0  # L, P, S: the nose is in front
    assert np.linalg.norm(surface.vertices - nose, axis=1).min() < 1e-3
    assert dicom_bytes(HERE, frame, "P017") == data != dicom_bytes(HERE, frame, "P018")


def test_the_mask_lies_where_the_head_is(tmp_path: Path) -> None:
    later = moved(HERE)
    frame = frankfurt_axes(later.measured, "RAS")
    document = write_hospital_files(tmp_path, later, frame, "nifti", "P017")
    assert document == json.loads((tmp_path / "frame.json").read_text())
    image = Nifti1Image.from_filename(tmp_path / "sub-P017_desc-head_mask.nii.gz")
    affine = np.asarray(image.affine)
    assert aff2axcodes(affine) == ("R", "A", "S")
    mask = np.asarray(image.dataobj)
    mesh = later.measured.mesh_world
    normals = mesh.normals() @ frame.patient_from_world.rotation.T
    skin = frame.patient_from_world.apply(mesh.vertices)
    found = []
    for depth_mm in (-2.0, 2.0):  # below the skin and above it
        voxels = np.linalg.solve(affine[:3, :3], (skin + depth_mm * normals - affine[:3, 3]).T)
        found.append(map_coordinates(mask, voxels, order=0).mean())
    assert found[0] > 0.97  # lips, lids and ears are thinner
    assert found[1] < 0.03


def test_voxels_fill_the_volume_of_a_closed_mesh() -> None:
    made = trimesh.creation.icosphere(4, 20.0)
    mask, affine = fill_voxels(Mesh(np.asarray(made.vertices), np.asarray(made.faces, np.int32)))
    assert int(mask.sum()) == pytest.approx(made.volume, rel=0.003)
    np.testing.assert_allclose(np.argwhere(mask).mean(axis=0) @ affine[:3, :3] + affine[:3, 3], 0.0, atol=0.51)
