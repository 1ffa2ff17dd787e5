import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.evidence.measurements import Landmark, Measurement
from pipeline.faces.matching import complete_match
from pipeline.faces.subject import SubjectFaces
from pipeline.faces.triangulated_face import triangulate_face
from pipeline.geometry.projection import depth_map
from pipeline.imaging.silhouette import ViewQuality, silhouette_from_mask
from pipeline.results import report
from pipeline.results.overlays import (
    DARKEST,
    FITTED_COLOUR,
    INPUT_COLOUR,
    KEY_PX,
    LAMP,
    PART_COLOURS,
    SKIN,
    TINT,
    clay,
    lit,
    overlay,
)
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report_types import FaceReport
from pipeline.results.write import write_result
from pipeline.settings import OutputSettings, Settings
from rig.capture import Capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.images import read_image
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.messages.message import compose
from tests.support.drawn_faces import seen_face
from tests.support.drawn_studio import drawn_studio
from tests.support.made_up_results import made_up_result
from tests.support.scenes import ellipsoid, fan, pattern
from tests.support.scripts import import_script
from tests.support.shared_data import shared

CONTRACT_KEYS = {
    "format", "model", "method", "cameras", "coefficients", "world_from_head", "landmarks", "measurements", "front",
    "seconds", "evaluations", "stopped_because", "inputs", "warnings", "version",
}  # fmt: skip
PLACE = Similarity(1.25, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))


@pytest.fixture(scope="module")
def scene() -> tuple[Reconstruction, Capture]:
    rig, head = fan(), ellipsoid(4)
    world = Mesh(PLACE.apply(head.vertices), head.faces)
    colours = np.round(pattern(head.vertices) * 255).astype(np.uint8)
    masks = {camera.name: np.isfinite(depth_map(camera, world.vertices, world.faces)[0]) for camera in rig}
    images = {name: np.where(mask[:, :, None], 180, 60).astype(np.uint8).repeat(3, 2) for name, mask in masks.items()}
    shifted = {name: np.roll(mask, 6, axis=1) for name, mask in masks.items()}
    figures = {name: CameraFigures(True, 0.99, 0.4, 12.5, 90.0, 0.02, 300) for name in rig.names}
    figures["cam03"] = CameraFigures(False, None, None, None)
    silhouettes = {name: silhouette_from_mask(mask) for name, mask in masks.items()}
    silhouettes["cam03"] = replace(silhouettes["cam03"], quality=ViewQuality(usable=False, contrast=float("inf")))
    fit = Fit("contour", np.array([0.5, -1.0]), PLACE, 42, "the cost no longer falls")
    result = made_up_result(
        world,
        fit,
        colours=colours,
        views=np.r_[np.zeros(5, np.uint8), np.full(len(head.vertices) - 5, 3, np.uint8)],
        deviation_mm=np.linspace(0.1, 2.0, len(head.vertices)),
        silhouettes=silhouettes,
        start_masks=shifted,
        fitted_masks=masks,
        cameras=figures,
        landmarks={"pronasale": Landmark(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]))},
        measurements={"nose_length": Measurement(52.0, float("nan"))},
        name="ellipsoid",
        front="cam03",
        settings=Settings(outputs=OutputSettings(formats=("glb", "ply", "obj"))),
        seconds={"segmentation": 0.5, "fitting": 1.5},
        warnings=(compose("view-left-out", remark="cam03: left out"),),
    )
    return result, Capture({name: image[:, :, :3].copy() for name, image in images.items()})


@pytest.fixture(scope="module")
def folder(scene: tuple[Reconstruction, Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result")
    write_result(out, *scene)
    return out


def read_vertices(path: Path) -> tuple[list[str], np.ndarray]:
    """An independent reader of the PLY of docs/capture-format.md: header lines, vertex records."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode("ascii").splitlines()
    count = int(next(line.split()[2] for line in header if line.startswith("element vertex")))
    record = np.dtype(
        [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")]
        + [(n, "u1") for n in "rgb"]
        + [("q", "<f4"), ("views", "u1")]
    )
    return header, np.frombuffer(data, record, count, end)


def test_ply_holds_the_world_mesh_with_its_colours_quality_and_views(folder: Path, scene) -> None:
    result, _ = scene
    header, vertices = read_vertices(folder / "head.ply")
    assert header[1] == "format binary_little_endian 1.0"
    assert [line for line in header if line.startswith("property")] == [
        *(f"property float {n}" for n in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {n}" for n in ("red", "green", "blue")),
        "property float quality", "property uchar views", "property list uchar int vertex_indices",
    ]  # fmt: skip
    np.testing.assert_allclose(np.stack([vertices[n] for n in "xyz"], 1), result.mesh_world.vertices, atol=1e-4)
    np.testing.assert_array_equal(np.stack([vertices[n] for n in "rgb"], 1), result.texturing.vertices.colours)
    np.testing.assert_allclose(vertices["q"], result.refined.deviation_mm, rtol=1e-6)
    assert (vertices["views"][:6] == [0, 0, 0, 0, 0, 3]).all()
    comments = " ".join(line for line in header if line.startswith("comment"))
    for word in ("unit mm", "frame world", "model ellipsoid", "ab" * 32, "inputs", "settings", "version"):
        assert word in comments


def test_one_result_is_the_same_bytes_and_others_change_the_comments(folder: Path, scene, tmp_path: Path) -> None:
    result, capture = scene
    write_result(tmp_path, replace(result, seconds={"segmentation": 9.0}), capture)
    for file in sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "report.json"):
        assert (tmp_path / file.relative_to(folder)).read_bytes() == file.read_bytes(), file.name
    write_result(tmp_path / "a", replace(result, digests={"images/cam00.png": "ef" * 32}), capture)
    write_result(tmp_path / "b", replace(result, settings=Settings(method="simplex")), capture)
    headers = [read_vertices(p / "head.ply")[0] for p in (folder, tmp_path / "a", tmp_path / "b")]
    assert len({tuple(header) for header in headers}) == 3


def test_glb_is_the_head_frame_in_metres(folder: Path) -> None:
    head = ellipsoid(4)
    loaded = read_mesh(folder / "head.glb")
    # The pose is undone and the size kept: the head's own shape times the scale.
    np.testing.assert_allclose(loaded.vertices * 1000, 1.25 * head.vertices, atol=2e-2)


def test_report_has_every_key_of_the_contract_and_only_json_numbers(folder: Path) -> None:
    def refuse(word: str) -> None:
        raise AssertionError(f"report.json holds {word}")

    report = json.loads((folder / "report.json").read_text(), parse_constant=refuse)
    assert set(report) >= CONTRACT_KEYS
    assert report["format"] == "eigenhead-report/1"
    assert set(report["cameras"]["cam00"]) >= {"iou", "contour_rms_px", "xor_cost", "used", "excluded_share"}
    assert report["cameras"]["cam03"]["used"] is False
    assert report["cameras"]["cam03"]["view"]["contrast"] is None
    assert report["seconds"] == {"total": 2.0, "segmentation": 0.5, "fitting": 1.5}
    assert report["texture"]["filled"] == 5
    assert report["warnings"] == [compose("view-left-out", remark="cam03: left out").document()]
    assert report["landmarks"]["pronasale"] == {"position": [1.0, 2.0, 3.0], "std": [0.1, 0.2, 0.3]}
    assert report["measurements"]["nose_length"] == {"value": 52.0, "std": None}


def test_the_reported_similarity_has_the_papers_form(folder: Path) -> None:
    place = json.loads((folder / "report.json").read_text())["world_from_head"]
    points = np.random.default_rng(1).normal(size=(5, 3)) * 100
    rotation, translation = np.array(place["rotation"]), np.array(place["translation"])
    np.testing.assert_allclose(place["scale"] * (points @ rotation.T + translation), PLACE.apply(points), atol=1e-9)


def test_every_camera_has_an_overlay_of_its_image_with_both_contours(folder: Path, scene) -> None:
    _, capture = scene
    for name, image in capture.images.items():
        drawn = read_image(folder / "overlays" / f"{name}.png")
        assert drawn.shape == image.shape
        changed = (drawn != image).any(axis=2)
        assert 0.002 < changed.mean() < 0.15
    for picture in ("contact_sheet.png", "turntable.png"):
        assert read_image(folder / picture).std() > 10
    key = read_image(folder / "contact_sheet.png")[-KEY_PX:]
    assert all((key == colour).all(axis=2).any() for colour in (INPUT_COLOUR, FITTED_COLOUR))


def test_contours_are_painted_where_they_are() -> None:
    image = np.full((240, 320, 3), 128, np.uint8)
    observed, fitted = np.zeros((2, 240, 320), bool)
    observed[60:200, 100:200], fitted[60:200, 140:260] = True, True
    drawn = overlay(image, silhouette_from_mask(observed).distance, fitted).astype(float)
    row = drawn[150]
    # The contour runs half a pixel outside the outermost pixel centre: x = 99.5 and 259.5.
    for x, colour in ((99.5, INPUT_COLOUR), (259.5, FITTED_COLOUR)):
        window = np.arange(int(x) - 8, int(x) + 9)
        near = np.abs(row[window] - np.array(colour)).sum(axis=1)
        assert sorted(window[np.argsort(near)[:2]]) == [int(x), int(x) + 1]
    assert (row[20] == 128).all()
    assert (row[170] == 128).all()


def test_parts_tint_by_their_probability_and_the_unknown_keeps_its_colour() -> None:
    image = np.full((240, 320, 3), 128, np.uint8)
    parts = np.zeros((240, 320, 3), np.float32)
    parts[120:160, 200:220, 0], parts[120:160, 220:240, 1] = 1.0, 0.5  # surely skin; hair or unknown
    far = np.full((240, 320), 1e3, np.float32)
    drawn = overlay(image, far, np.zeros((240, 320), bool), parts=parts).astype(float)
    skin, hair = (np.array(PART_COLOURS[name], float) for name in ("skin", "hair"))
    np.testing.assert_allclose(drawn[140, 210], 128 + TINT * (skin - 128), atol=0.51)
    np.testing.assert_allclose(drawn[140, 230], 128 + 0.5 * TINT * (hair - 128), atol=0.51)
    assert (drawn[200:, :] == 128).all()
    named = overlay(image, far, np.zeros((240, 320), bool))
    assert (drawn[:130, :100] != named[:130, :100]).any()  # the legend says which colour is which part


def test_the_shared_checker_finds_no_breach_of_the_contract(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = shared("tools/score.py")
    monkeypatch.syspath_prepend(str(path.parent))
    faults, mesh = import_script(path).check_result(str(folder))
    assert faults == []
    assert mesh is not None


def test_each_camera_has_its_face_and_nothing_else() -> None:
    rig, rng = drawn_studio(), np.random.default_rng(3)
    placed = Similarity(1.0, np.eye(3), np.zeros(3))
    detections = {name: seen_face(placed, rig[name], rng, score=31.5) for name in ("cam0", "cam1", "cam2")}
    face = triangulate_face(detections, rig)
    assert face is not None
    subject = SubjectFaces({"cam3": (), **{n: (d,) for n, d in detections.items()}}, complete_match(face, {}, rig), ())
    found = report._faces(subject, rig.names)
    assert list(found) == list(rig.names)
    for name, of_camera in found.items():
        assert of_camera.keys() == FaceReport.__annotations__.keys()
        assert of_camera.keys() == {"found", "box_px", "roll_deg", "landmarks", "score"}
        assert of_camera["found"] == (name in detections)
    assert found["cam0"]["landmarks"] == 468
    assert found["cam0"]["score"] == 31.5
    assert found["cam0"]["box_px"] == pytest.approx(detections["cam0"].box_px.tolist())
    assert found["cam5"] == {"found": False, "box_px": None, "roll_deg": None, "landmarks": 0, "score": None}


def test_where_views_do_not_agree_no_camera_has_the_subject() -> None:
    rig, rng = drawn_studio(), np.random.default_rng(3)
    seen = {"cam0": (seen_face(Similarity(1.0, np.eye(3), np.zeros(3)), rig["cam0"], rng),)}
    assert not any(one["found"] for one in report._faces(SubjectFaces(seen, None, ()), rig.names).values())


BALL = ellipsoid(3)
WHITE = (255, 255, 255)


def area(mesh: Mesh, box: tuple[np.ndarray, np.ndarray]) -> int:
    return int((clay(mesh, panel=(120, 160), box=box, paper=WHITE) < 250).any(axis=2).sum())


def test_the_side_to_the_lamp_is_bright_and_the_other_is_not_black() -> None:
    normals, colours = BALL.normals(), lit(BALL)
    towards = normals @ LAMP
    np.testing.assert_allclose(colours[towards.argmin()], DARKEST * SKIN, atol=1.0)
    np.testing.assert_allclose(colours[towards.argmax()], SKIN, atol=2.0)
    blue = np.tile(np.array([0, 0, 200], np.uint8), (len(normals), 1))
    assert lit(BALL, blue, darkest=1.0).tolist() == blue.tolist()


def test_a_box_shows_a_head_of_half_the_size_at_half_the_size() -> None:
    box = (BALL.vertices.min(axis=0), BALL.vertices.max(axis=0))
    middle = (box[0] + box[1]) / 2
    half = Mesh(middle + (BALL.vertices - middle) / 2, BALL.faces)
    assert 0.22 < area(half, box) / area(BALL, box) < 0.27  # a quarter, less perspective
