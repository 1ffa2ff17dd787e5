"""head-NAME.glb and head-NAME-shapes.npz of a made-up result."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.templates.make import read_flame
from pipeline.applications.templates.write.writers import template_writers
from pipeline.contour_fit.fit import Fit
from pipeline.evidence.expression import BlendshapeRig, build_blendshape_rig
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.head_model.expressions import VISEMES
from pipeline.head_model.model import load_model
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.write import write_result
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.faces import Faces
from rig.capture import Capture
from rig.formats.meshes.polygon_obj import read_polygons
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from tests.support.glb import opened_glb
from tests.support.made_up_flame import flame_surface, flame_template, made_up_flame, write_archive
from tests.support.made_up_results import made_up_result
from tests.support.ready_templates import EYE_CENTRE, ready_template

GAZE = np.array([0.6, 0.0, 0.8])  # of the left eye, head frame
NAMES = ("jawOpen", "browInnerUp")
PLACE = Similarity(1.1, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    """The mean head, with two of Apple's shapes."""
    model = load_model()
    world = Mesh(PLACE.apply(model.vertices(np.zeros(0))), model.levels["full"].faces)
    whole = build_blendshape_rig(model, PLACE, world, ())
    morphs = {name: whole.morphs[name] for name in NAMES}
    shapes = BlendshapeRig(world, morphs, {"jawOpen": 0.25, "browInnerUp": 0.0}, whole.missing)
    made = made_up_result(world, Fit("contour", np.zeros(1), PLACE, 42, "the cost no longer falls"))
    iris = Iris(np.zeros(3), PLACE.rotation @ GAZE, 5.85, np.eye(7), ("cam00", "cam01"))
    eyes = {"left": iris, "right": UnseenEye("closed")}
    return replace(made, evidence=replace(made.evidence, blendshape_rig=shapes), faces=Faces(None, {}, eyes))


def written(result: Reconstruction, folder: Path, *, morphs: bool, lips_part: bool = False) -> set[str]:
    outputs = OutputSettings(surface="head", formats=("ply", "obj"), template="low", morphs=morphs, neutral=not morphs)
    chosen = replace(result, settings=Settings(outputs=outputs))
    write_result(folder, chosen, Capture({}), template_writers(ready_template(load_model(), lips_part=lips_part)))
    return {path.name for path in folder.iterdir()}


def test_shapes_are_written_where_morphs_are_asked_for(result: Reconstruction, tmp_path: Path) -> None:
    (tmp_path / "morphs").mkdir()
    (tmp_path / "none").mkdir()
    ours = {"head-low.glb", "head-low-shapes.npz", "head-low-parts.obj"}
    assert ours < written(result, tmp_path / "morphs", morphs=True)
    assert not ours & written(result, tmp_path / "none", morphs=False)
    with np.load(tmp_path / "morphs" / "head-low-shapes.npz") as file:
        meta = json.loads(file["meta"].tobytes())
        neutral, displacements = file["neutral"], file["displacements"]
    assert (meta["format"], meta["frame"], meta["unit"]) == ("eigenhead-shapes/1", "head", "mm")
    assert meta["names"] == [*NAMES, *VISEMES]
    assert meta["without_counterpart"] == ["tongueOut"]
    assert meta["inner_mouth"] == {"parts": [], "absence": "mouth-sealed"}
    assert meta["visemes"]["viseme_aa"]["jawOpen"] == 0.6
    model, level = load_model(), load_model().levels["p95"]
    np.testing.assert_allclose(neutral[: level.count], 1.1 * model.vertices(np.zeros(0), "p95"), atol=0.05)
    true = 1.1 * (level.operator @ model.expressions.moved({"browInnerUp": 1.0}))
    np.testing.assert_allclose(displacements[1, : level.count], true, atol=0.05)
    assert not displacements[:, level.count :].any()  # the eyeball
    np.testing.assert_allclose(meta["pivots"]["eye_left"], 1.1 * EYE_CENTRE, atol=1.0)
    document, _ = opened_glb((tmp_path / "morphs" / "head-low.glb").read_bytes())
    head, eye = document["meshes"]
    assert head["extras"]["targetNames"] == meta["names"]
    assert head["weights"][0] == 0.25
    assert (head["name"], eye["name"]) == ("head", "eye_left")
    nodes = {node["name"]: node for node in document["nodes"]}
    assert set(nodes) == {"head", "jaw", "eye_left", "eye_right", "neck"}
    assert nodes["eye_left"]["extras"]["rows"] == list(range(level.count, len(neutral)))
    assert nodes["head"]["extras"]["rows"] == list(range(level.count))
    np.testing.assert_allclose(meta["gazes"]["eye_left"], GAZE, atol=1e-9)
    half = 0.5 * np.arctan2(0.6, 0.8)
    np.testing.assert_allclose(nodes["eye_left"]["rotation"], (0.0, np.sin(half), 0.0, np.cos(half)), atol=1e-9)
    assert "rotation" not in nodes["eye_right"]
    parts = (tmp_path / "morphs" / "head-low-parts.obj").read_text().splitlines()
    assert [line for line in parts if line.startswith("o ")] == ["o head", "o eye_left"]


def test_teeth_and_tongue_are_written_where_lips_part(result: Reconstruction, tmp_path: Path) -> None:
    written(result, tmp_path, morphs=True, lips_part=True)
    with np.load(tmp_path / "head-low-shapes.npz") as file:
        meta, arrays = json.loads(file["meta"].tobytes()), {name: file[name] for name in file.files}
    parts = ["teeth_upper", "teeth_lower", "tongue"]
    assert meta["inner_mouth"] == {"parts": parts, "absence": None}
    assert meta["without_counterpart"] == []
    assert sorted(np.unique(arrays["inner_parts"])) == [0, 1, 2]
    opened = arrays["inner_displacements"][meta["names"].index("jawOpen")]
    assert not opened[arrays["inner_parts"] == 0].any()
    assert (opened[arrays["inner_parts"] > 0][:, 1] < 0.0).mean() > 0.9
    assert arrays["inner_triangles"].max() == len(arrays["inner_vertices"]) - 1
    document, _ = opened_glb((tmp_path / "head-low.glb").read_bytes())
    assert document["asset"]["extras"]["inner_mouth"] == "added"
    assert [mesh["name"] for mesh in document["meshes"]] == ["head", "eye_left", *parts]


ELSEWHERE = Similarity(1.1, rotation_from_vector(np.array([0.1, -2.3, 0.05])), np.array([1200.0, -700.0, 300.0]))


def test_the_parameters_make_the_written_head(tmp_path: Path) -> None:
    model, arrays = load_model(), made_up_flame()
    head = Mesh(ELSEWHERE.apply(model.vertices(np.full(5, 0.7))), model.levels["full"].faces)
    template = flame_template(read_flame(write_archive(tmp_path / "flame.npz", arrays)), model)
    result = made_up_result(head, Fit("contour", np.zeros(5), ELSEWHERE, 42, "the cost no longer falls"))
    outputs = OutputSettings(surface="head", formats=("ply",), template="flame")
    write_result(tmp_path, replace(result, settings=Settings(outputs=outputs)), Capture({}), template_writers(template))
    with np.load(tmp_path / "flame_param.npz") as file:
        parameters = dict(file)
    assert {name: array.shape for name, array in parameters.items()} == {
        "shape": (300,), "expr": (1, 100), "rotation": (1, 3), "neck_pose": (1, 3), "jaw_pose": (1, 3),
        "eyes_pose": (1, 6), "translation": (1, 3), "static_offset": (1, len(arrays["v_template"]), 3),
    }  # fmt: skip
    assert all(array.dtype == np.float32 for array in parameters.values())
    made = read_polygons(tmp_path / "head-flame.obj").vertices
    np.testing.assert_allclose(flame_surface(arrays, parameters) * 1000.0, made, atol=0.01)
    without = {name: array for name, array in parameters.items() if name != "static_offset"}
    off = np.linalg.norm(flame_surface(arrays, without) * 1000.0 - made, axis=1)
    report = json.loads((tmp_path / "report.json").read_text())["template"]["flame"]
    skin = template.surface_binding.skin
    np.testing.assert_allclose(report["residual_median_mm"], np.median(off[skin]), atol=0.01)
    np.testing.assert_allclose(report["residual_p95_mm"], np.percentile(off[skin], 95), atol=0.02)
    assert report["residual_median_mm"] < 1.0
