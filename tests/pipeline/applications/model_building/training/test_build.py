"""Raw scans to a model file: bad scans are repaired or refused by name, and the model made of the rest is true."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from pipeline.applications.model_building.correspondence.scan_checks import BadScan, check, outward_share
from pipeline.applications.model_building.correspondence.scans import Scan, read_scan
from pipeline.applications.model_building.training.build import build_model
from pipeline.applications.model_building.training.figures import Scanner, scan_head
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.landmarks import NAMES, mirrored
from pipeline.head_model.model import HeadModel, load_model
from rig.errors import InputError
from rig.geometry import rigid_fit
from rig.mesh import Mesh
from rig.progress import discard_progress
from tests.support.glb import obj_bytes
from tests.support.landmark_files import write_landmarks

SUBJECTS = (4, 40, 100, 120)


def scanned(model: HeadModel, subject: int, spacing_mm: float) -> Scan:
    head = model.vertices(model.scores[subject].astype(float))
    scanner = Scanner(spacing_mm=spacing_mm)
    rng = np.random.default_rng(subject)
    return scan_head(f"subject{subject}", head, model.levels["full"].faces, model.landmarks, scanner, rng)


@pytest.fixture(scope="module")
def sound(model: HeadModel) -> Scan:
    return scanned(model, 7, 3.0)


def scaled(scan: Scan, factor: float) -> Scan:
    marks = {name: point * factor for name, point in scan.landmarks.items()}
    return replace(scan, vertices=scan.vertices * factor, landmarks=marks)


def swapped(scan: Scan, *pairs: str) -> Scan:
    """Left and right exchanged, of all landmarks or the given pairs."""
    names = {n: mirrored(n) if not pairs or n.startswith(pairs) else n for n in NAMES}
    return replace(scan, landmarks={n: scan.landmarks[other] for n, other in names.items()})


def inverted(scan: Scan) -> Scan:
    return replace(scan, faces=scan.faces[:, ::-1])


def x_flipped(scan: Scan) -> Scan:
    """A file written with x the other way: points and landmarks change sign, triangles keep their order."""
    flip = np.array([-1.0, 1.0, 1.0])
    marks = {name: point * flip for name, point in scan.landmarks.items()}
    return replace(scan, vertices=scan.vertices * flip, landmarks=marks)


def half_inverted(scan: Scan) -> Scan:
    faces = scan.faces.copy()
    some = np.random.default_rng(0).permutation(len(faces))[: len(faces) // 2]
    faces[some] = faces[some, ::-1]
    return replace(scan, faces=faces)


def holed(scan: Scan, name: str, radius: float) -> Scan:
    away = np.linalg.norm(scan.vertices - scan.landmarks[name], axis=1)
    kept = (away > radius)[scan.faces].all(1)
    return replace(scan, faces=scan.faces[kept])


def beheaded(scan: Scan) -> Scan:
    """Only the front half, as a face scanner delivers it."""
    middle = (scan.landmarks["tragion_left"] + scan.landmarks["tragion_right"]) / 2
    return replace(scan, faces=scan.faces[(scan.vertices[:, 2] > middle[2])[scan.faces].all(1)])


def moved(scan: Scan, name: str, by: float) -> Scan:
    return replace(scan, landmarks={**scan.landmarks, name: scan.landmarks[name] + [0, by, 0]})


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda s: s, None),
        (lambda s: scaled(s, 0.1), "from cm to mm"),
        (lambda s: scaled(s, 0.001), "from m to mm"),
        (swapped, "swapped left and right"),
        (inverted, "faced inwards"),
        (x_flipped, "mirrored back"),
        (lambda s: scaled(inverted(s), 0.1), "faced inwards"),
        (lambda s: holed(s, "glabella", 8.0), None),
    ],
    ids=["sound", "cm", "m", "swapped", "inverted", "mirrored", "cm and inverted", "small hole"],
)
def test_plain_faults_are_mended(
    sound: Scan, model: HeadModel, spoil: Callable[[Scan], Scan], word: str | None
) -> None:
    """Whatever was done to it, the scan that comes out is the sound one (but for the hole, which stays)."""
    checked = check(spoil(sound), model)
    assert word in "; ".join(checked.repairs) if word else checked.repairs == ()
    np.testing.assert_allclose(checked.scan.vertices, sound.vertices, atol=1e-9)
    for name in NAMES:
        np.testing.assert_allclose(checked.scan.landmarks[name], sound.landmarks[name], atol=1e-9)
    kept = {tuple(sorted(face)) for face in checked.scan.faces.tolist()}
    assert kept <= {tuple(sorted(face)) for face in sound.faces.tolist()}
    assert outward_share(checked.scan, model) > 0.9


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda s: scaled(s, 3.0), "scale it to mm"),
        (lambda s: scaled(s, 1 / 25.4), "scale it to mm"),
        (lambda s: swapped(s, "cheilion"), "cheilion_left and cheilion_right are swapped"),
        (lambda s: replace(s, vertices=s.vertices * 0.001), "off the surface"),
        (half_inverted, "face opposite ways"),
        (lambda s: holed(s, "pronasale", 25.0), "in the face"),
        (beheaded, "in the head"),
        (lambda s: moved(s, "pogonion", -70.0), "pogonion"),
        (lambda s: replace(s, landmarks={"pronasale": np.zeros(3)}), "lacks landmarks: glabella"),
        (lambda s: replace(s, faces=s.faces[:10]), "needs thousands"),
    ],
    ids=["x3", "inches", "one pair", "mesh in m", "half inverted", "face hole", "no back", "chin", "few marks", "few"],
)
def test_everything_else_is_refused(sound: Scan, model: HeadModel, spoil: Callable[[Scan], Scan], word: str) -> None:
    with pytest.raises(BadScan, match=word):
        check(spoil(sound), model)


def test_the_shipped_population_passes(model: HeadModel) -> None:
    """No head of the database is taken for a bad scan, though coarse and noisy."""
    for subject in (0, 33, 66, 99, 137):
        assert check(scanned(model, subject, 4.0), model).repairs == ()


def write_scan(folder: Path, scan: Scan) -> None:
    (folder / f"{scan.name}.obj").write_bytes(obj_bytes(Mesh(scan.vertices, scan.faces, None)))
    write_landmarks(folder / f"{scan.name}.json", scan.landmarks)


def exported(mesh: trimesh.Trimesh | trimesh.Scene, kind: str, **options: str) -> bytes:
    data = mesh.export(file_type=kind, **options)
    assert isinstance(data, bytes)
    return data


def ascii_ply(scan: Scan) -> bytes:
    return exported(trimesh.Trimesh(scan.vertices, scan.faces, process=False), "ply", encoding="ascii")


def seamed_obj(scan: Scan) -> bytes:
    """Two materials, and texture coordinates of its own for each corner: every vertex lies on a seam."""
    lines = ["mtllib none.mtl", *(f"v {x} {y} {z}" for x, y, z in scan.vertices.tolist())]
    lines += [f"vt {k % 97 / 97:.4f} {k % 89 / 89:.4f}" for k in range(3 * len(scan.faces))]
    for k, face in enumerate((scan.faces + 1).tolist()):
        if k in (0, len(scan.faces) // 2):
            lines.append(f"usemtl part{k}")
        lines.append("f " + " ".join(f"{v}/{3 * k + corner + 1}" for corner, v in enumerate(face)))
    return "\n".join(lines).encode()


def placed_glb(scan: Scan) -> bytes:
    """The mesh half as large and aside, and a node that puts it right."""
    scene = trimesh.Scene()
    node = np.diag([2.0, 2.0, 2.0, 1.0]) + np.array([[0, 0, 0, 5.0], [0] * 4, [0] * 4, [0] * 4])
    inner = trimesh.Trimesh((scan.vertices - [5.0, 0, 0]) / 2, scan.faces, process=False)
    scene.add_geometry(inner, transform=node)
    return exported(scene, "glb")


def soup_ply(scan: Scan) -> bytes:
    """Three vertices for every triangle."""
    corners = scan.vertices[scan.faces].reshape(-1, 3)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    return exported(trimesh.Trimesh(corners, triangles, process=False), "ply")


@pytest.mark.parametrize(
    ("name", "written"),
    [("a.ply", ascii_ply), ("b.obj", seamed_obj), ("c.glb", placed_glb), ("d.ply", soup_ply)],
    ids=["ascii", "seams", "node", "soup"],
)
def test_files_as_other_programs_write_them_come_out_alike(
    tmp_path: Path, sound: Scan, name: str, written: Callable[[Scan], bytes]
) -> None:
    """One connected surface of the same triangles, whatever the file repeats (single precision: 0.01 mm)."""
    (tmp_path / name).write_bytes(written(sound))
    write_landmarks((tmp_path / name).with_suffix(".json"), sound.landmarks)
    scan = read_scan(tmp_path / name)
    assert len(scan.vertices) == len(np.unique(sound.faces))
    assert len(scan.faces) == len(sound.faces)
    mine, theirs = (v[f].mean(1) for v, f in ((scan.vertices, scan.faces), (sound.vertices, sound.faces)))
    assert KDTree(theirs).query(mine)[0].max() < 0.01


def test_bad_scans_stop_the_build_and_all_are_named(tmp_path: Path, sound: Scan) -> None:
    for name, scan in (("a", holed(sound, "pronasale", 25.0)), ("b", swapped(sound, "alare")), ("c", sound)):
        write_scan(tmp_path, replace(scan, name=name))
    with pytest.raises(InputError) as caught:
        build_model(tmp_path, tmp_path / "out.npz", name="x", report=discard_progress)
    assert "scan a" in str(caught.value)
    assert "alare_left" in str(caught.value)
    with pytest.raises(InputError, match="1 sound scans, needed are 3"):
        build_model(tmp_path, tmp_path / "out.npz", name="x", on_bad="skip", report=discard_progress)
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.slow
def test_a_folder_of_scans_becomes_a_model_of_those_heads(tmp_path: Path, model: HeadModel) -> None:
    """Each scanned head, in its own coefficients, lies on the true head: half a millimetre over the face region."""
    for subject in SUBJECTS:
        write_scan(tmp_path, scanned(model, subject, 2.0))
    write_scan(tmp_path, replace(swapped(scanned(model, 9, 3.0), "alare"), name="wrong"))
    stages: list[str] = []
    out = tmp_path / "built.npz"
    built = build_model(tmp_path, out, name="mine", on_bad="skip", report=lambda s, f: stages.append(s))
    assert set(built.used) == {f"subject{k}" for k in SUBJECTS}
    assert set(built.skipped) == {"wrong"}
    assert {"checking scans", "refining", "aligning"} <= set(stages)
    mine = load_model(out)
    assert mine.name == "mine"
    assert len(mine.modes) == len(SUBJECTS) - 1
    faces, region = model.levels["full"].faces, mine.levels["full"].face_region
    for name, scores in zip(built.used, mine.scores, strict=True):
        truth = model.vertices(model.scores[int(name.removeprefix("subject"))].astype(float))
        head = mine.vertices(scores.astype(float))
        # scores and truths differ by a rigid motion, which corresponding landmarks begin and the surface ends
        marks = list(model.landmarks.values())
        points = rigid_fit(head[marks], truth[marks]).apply(head)[region][::5]
        for _ in range(8):
            near = SurfaceIndex(truth, faces).closest(points)
            points = rigid_fit(points, near.points).apply(points)
        assert np.median(SurfaceIndex(truth, faces).closest(points).distances) < 0.5
