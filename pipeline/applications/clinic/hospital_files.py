"""Writes a head for a hospital's programs, without the patient's name and without date: a closed STL in a DICOM object,
or a NIfTI mask.

DICOM objects follow PS3.3 A.85.1 (Encapsulated STL), in LPS axes, mm. The face stays recognisable, and the DICOM object
says so; the patient has a pseudonym that the caller chooses. NIfTI-1 masks are in RAS axes, mm; voxels are 1 in the
head and 0 outside. Repeated exports of the same head give the same bytes."""

import gzip
import hashlib
import importlib
import io
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.applications.clinic.anatomical_frame import AnatomicalFrame
from pipeline.applications.clinic.patient_files import FRAME_FILE, frame_document, write_json
from pipeline.applications.clinic.visit import Visit
from pipeline.results.head_files import close_borders
from rig.errors import EigenheadError, how_to_install
from rig.files import write_atomically
from rig.formats.meshes.markups import Axes
from rig.formats.meshes.printing import stl_bytes
from rig.mesh import Mesh
from rig.messages.message import compose

HospitalFormat = Literal["dicom", "nifti"]
HOSPITAL_AXES: dict[HospitalFormat, Axes] = {"dicom": "LPS", "nifti": "RAS"}
VOXEL_MM = 1.0  # as usual volumes of MR and CT have it
OFF_GRID = (0.00071, 0.00037)  # voxels: so that no ray meets an edge or a vertex whose coordinates are whole


class NoClinic(EigenheadError):
    """Reports that the optional packages of the extra ``clinic`` are not installed."""

    def __init__(self) -> None:
        super().__init__(compose("clinic-not-installed", remedy=how_to_install("clinic")))


def clinic_module(name: str) -> Any:
    """Imports ``pydicom`` or ``nibabel`` as Any, because their type annotations are incomplete. Raises NoClinic."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise NoClinic from None


def write_hospital_files(
    folder: Path, visit: Visit, frame: AnatomicalFrame, form: HospitalFormat, patient: str
) -> dict[str, Any]:
    """Writes head.dcm or a NIfTI mask, and frame.json; returns the content of frame.json. ``frame`` must have the axes
    of the format; ``patient`` consists of letters and digits. Raises NoClinic, NotAManifold and OSError."""
    if form == "dicom":
        write_atomically(folder / "head.dcm", dicom_bytes(visit, frame, patient))
    else:
        write_atomically(folder / f"sub-{patient}_desc-head_mask.nii.gz", nifti_bytes(visit, frame))
    document = frame_document(visit, frame)
    write_json(folder / FRAME_FILE, document)
    return document


def close_head(visit: Visit, frame: AnatomicalFrame) -> Mesh:
    """Returns the head as a closed mesh in the axes of ``frame``, mm. Raises NotAManifold."""
    head_from_world = visit.measured.head_from_world
    mesh = visit.measured.mesh_world
    closed = close_borders(Mesh(head_from_world.apply(mesh.vertices), mesh.faces))
    patient_from_head = frame.patient_from_world @ head_from_world.inverse()
    return Mesh(patient_from_head.apply(closed.vertices), closed.faces)


def dicom_bytes(visit: Visit, frame: AnatomicalFrame, patient: str) -> bytes:
    """Returns the head as a DICOM object of a patient with the pseudonym ``patient``. The object's identifiers are
    computed from the surface and the pseudonym. Raises NoClinic and NotAManifold."""
    pydicom, uids = clinic_module("pydicom"), clinic_module("pydicom.uid")
    surface = stl_bytes(close_head(visit, frame))
    digest = hashlib.sha256(patient.encode() + surface).hexdigest()
    study, series, instance, place = (uids.generate_uid(entropy_srcs=[digest, of]) for of in ("a", "b", "c", "d"))
    millimetre = pydicom.Dataset()
    millimetre.CodeValue, millimetre.CodingSchemeDesignator, millimetre.CodeMeaning = "mm", "UCUM", "mm"
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = uids.EncapsulatedSTLStorage, instance
    meta.TransferSyntaxUID = uids.ExplicitVRLittleEndian
    made = pydicom.Dataset()
    made.file_meta = meta
    fields = {
        "SpecificCharacterSet": "ISO_IR 192",
        "SOPClassUID": uids.EncapsulatedSTLStorage,
        "SOPInstanceUID": instance,
        "StudyInstanceUID": study,
        "SeriesInstanceUID": series,
        "FrameOfReferenceUID": place,
        "Modality": "M3D",
        "PatientName": patient,
        "PatientID": patient,
        "PatientIdentityRemoved": "YES",
        "DeidentificationMethod": "A pseudonym; no name, date or place. The face is kept",
        "LongitudinalTemporalInformationModified": "REMOVED",
        "RecognizableVisualFeatures": "YES",
        "BurnedInAnnotation": "NO",
        "Manufacturer": "eigenhead",
        "ManufacturerModelName": "eigenhead",
        "DeviceSerialNumber": "0",
        "SoftwareVersions": version("eigenhead"),
        "SeriesNumber": 1,
        "InstanceNumber": 1,
        "DocumentTitle": "Head",
        "MeasurementUnitsCodeSequence": [millimetre],
        "ModelModification": "NO",
        "ModelMirroring": "NO",
        "MIMETypeOfEncapsulatedDocument": "model/stl",
        "EncapsulatedDocument": surface + bytes(len(surface) % 2),
        "EncapsulatedDocumentLength": len(surface),
    }
    unknown = (
        "PatientBirthDate PatientSex StudyDate StudyTime ContentDate ContentTime AcquisitionDateTime StudyID "
        "AccessionNumber ReferringPhysicianName PositionReferenceIndicator ConceptNameCodeSequence"
    )
    for name, value in (dict.fromkeys(unknown.split()) | fields).items():
        setattr(made, name, value)
    data = io.BytesIO()
    pydicom.dcmwrite(data, made, enforce_file_format=True)
    return data.getvalue()


def nifti_bytes(visit: Visit, frame: AnatomicalFrame) -> bytes:
    """Returns the head as a compressed NIfTI mask (.nii.gz). Raises NoClinic and NotAManifold."""
    nibabel = clinic_module("nibabel")
    mask, affine = fill_voxels(close_head(visit, frame))
    image = nibabel.Nifti1Image(mask, affine)
    image.header.set_xyzt_units("mm")
    return gzip.compress(image.to_bytes(), mtime=0)


def fill_voxels(closed: Mesh) -> tuple[UInt8[np.ndarray, "x y z"], Float[np.ndarray, "4 4"]]:
    """Returns a mask of the voxels whose centre lies within a closed mesh (mm), and the affine transform from voxels to
    mm.

    A centre is inside if a vertical ray from below crosses the mesh an odd number of times up to the centre."""
    low = np.floor(closed.vertices.min(axis=0) / VOXEL_MM) - 1.0
    size = (np.ceil(closed.vertices.max(axis=0) / VOXEL_MM) - low + 2.0).astype(int)
    corners = (closed.vertices / VOXEL_MM - low)[closed.faces]
    corners[:, :, :2] += OFF_GRID
    corners = corners[_cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) != 0.0]  # not upright ones
    first = np.ceil(corners[:, :, :2].min(axis=1)).astype(int)
    spans = (np.floor(corners[:, :, :2].max(axis=1)).astype(int) - first + 1).clip(0)
    counts = spans.prod(axis=1)
    faces = np.repeat(np.arange(len(corners)), counts)
    within = np.arange(len(faces)) - np.repeat(np.cumsum(counts) - counts, counts)
    cells = first[faces] + np.stack([within // spans[faces, 1], within % spans[faces, 1]], axis=1)
    a, b, c = (corners[faces, corner] for corner in range(3))
    area = _cross(b - a, c - a)
    share_b, share_c = _cross(cells - a[:, :2], c - a) / area, _cross(b - a, cells - a[:, :2]) / area
    height = a[:, 2] + share_b * (b - a)[:, 2] + share_c * (c - a)[:, 2]
    met = (share_b >= 0.0) & (share_c >= 0.0) & (share_b + share_c <= 1.0)
    crossings = np.zeros(size, np.uint8)
    np.add.at(crossings, (*cells[met].T, np.ceil(height[met]).astype(int)), 1)
    affine = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    affine[:3, 3] = low * VOXEL_MM
    return np.cumsum(crossings, axis=2, dtype=np.uint8) % 2, affine


def _cross(one: Float[np.ndarray, "n _"], other: Float[np.ndarray, "n _"]) -> Float[np.ndarray, " n"]:
    """Returns the third component of the cross product of two sets of vectors."""
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
