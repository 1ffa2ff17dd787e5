"""The head's files in every format, from the model's own mean head."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from pipeline.applications.templates.write.writers import load_template_writers
from pipeline.contour_fit.fit import Fit
from pipeline.evidence.expression import build_blendshape_rig
from pipeline.evidence.measurements import Landmark
from pipeline.head_model.model import load_model
from pipeline.results.head_files import (
    head_mesh,
    landmarks_document,
    printable,
    write_formats,
    write_head_ply,
    write_skin_maps,
)
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report import report_document, skin_document
from pipeline.results.write import write_result
from pipeline.settings import OutputSettings, Settings, settings_from_document
from pipeline.texturing.albedo import Albedo
from pipeline.texturing.layout.normal_map import reduce_layout
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout, model_layout
from pipeline.texturing.light import Light
from pipeline.texturing.pores.skin_maps import SkinMaps, codes_of
from pipeline.texturing.sets.specular import Specular
from pipeline.texturing.sets.texture_sets import SetTextures
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.meshes.ply import read_head_ply
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from server.storage.result_folder import RESULT_FILE
from tests.rig.formats.pictures.test_exr import read_exr
from tests.support.glb import opened_glb
from tests.support.made_up_results import made_up_result, textured_result
from tests.support.scenes import ellipsoid

ALL = ("glb", "ply", "obj", "usdz", "stl", "3mf")


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    """The mean head, its texture red at the left of the layout and blue at the right."""
    model = load_model()
    mesh = Mesh(model.vertices(np.zeros(0)), model.levels["full"].faces)
    image = np.zeros((1024, 1024, 3), np.uint8)
    image[:, :512], image[:, 512:] = (200, 30, 30), (30, 30, 200)
    return textured_result(mesh, Atlas(model_layout(model).layout, image))


@pytest.fixture(scope="module")
def reduced_result(result: Reconstruction) -> Reconstruction:
    texturing = result.texturing
    assert texturing.atlas is not None
    reduced = reduce_layout(load_model(), texturing.atlas.layout)
    return replace(result, texturing=replace(texturing, reduced=reduced))


def written(result: Reconstruction, folder: Path, **outputs: object) -> set[str]:
    chosen = replace(result, settings=Settings(outputs=replace(OutputSettings(), **outputs)))
    write_head_ply(folder, chosen)
    write_formats(folder, chosen, head_mesh(chosen))
    return {path.name for path in folder.iterdir()}


def test_every_format_is_written_and_no_other(result: Reconstruction, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    for name in ("default", "all", "image"):
        (tmp_path / name).mkdir()
    assert written(result, tmp_path / "default") == {"head.ply", "head.glb"}
    every = {"head.ply", "head.glb", "head.obj", "head.mtl", "head.png", "head.usdz", "head.stl", "head.3mf"}
    assert written(result, tmp_path / "all", formats=ALL) == every
    assert written(result, tmp_path / "image", formats=("ply",), ply_texture=True) == {"head.ply", "head.png"}
    assert b"comment TextureFile head.png\n" in (tmp_path / "image" / "head.ply").read_bytes()[:2000]
    plain, named = (read_head_ply(tmp_path / name / "head.ply")[0] for name in ("default", "image"))
    np.testing.assert_array_equal(plain.vertices, named.vertices)


def test_the_glb_has_the_texture_upright_and_says_what_it_is(result: Reconstruction, tmp_path: Path) -> None:
    written(result, tmp_path)
    extras = opened_glb((tmp_path / "head.glb").read_bytes())[0]["asset"]["extras"]
    assert extras["model"] == {"name": result.model_name, "sha256": result.model_sha256}
    assert {"version", "unit", "inputs_sha256", "settings_sha256"} < set(extras)
    loaded = trimesh.load(tmp_path / "head.glb", force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    visual: Any = loaded.visual
    picture = np.asarray(visual.material.baseColorTexture.convert("RGB")).astype(int)
    at = np.clip((visual.uv * (1, -1) + (0, 1)) * len(picture), 0, len(picture) - 1).astype(int)
    seen = picture[at[:, 1], at[:, 0]]
    aside = loaded.vertices[:, 0]  # m, to the subject's left, which is at the layout's right
    assert (seen[aside > 0.04, 2] > 150).all()
    assert (seen[aside < -0.04, 0] > 150).all()
    count = len(result.mesh_world.vertices)
    repeated = np.asarray(loaded.vertices)[extras["repeated_vertices"]]
    np.testing.assert_array_equal(loaded.vertices[count:], repeated)


def test_the_printable_head_is_closed_and_stands_upright(result: Reconstruction) -> None:
    closed = printable(head_mesh(result))
    solid = trimesh.Trimesh(closed.vertices, closed.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert 2e6 < solid.volume < 8e6  # mm3: a head with its neck
    assert closed.vertices[:, 2].min() == 0
    crown = closed.vertices[closed.vertices[:, 2].argmax()]
    assert crown[2] > np.ptp(closed.vertices[:, 0])  # higher than wide


def test_open_lids_are_closed_by_strips() -> None:
    model = load_model()
    mesh = Mesh(model.vertices(np.zeros(0)), model.levels["full"].faces)
    eye = mesh.vertices[model.landmarks["exocanthion_left"]] - (12, 0, 0)
    off = np.abs(mesh.vertices[mesh.faces].mean(axis=1) - eye) / (10.0, 3.0, 30.0)
    opened = Mesh(mesh.vertices, mesh.faces[(off**2).sum(axis=1) > 1])
    assert len(opened.faces) < len(mesh.faces)
    used = np.unique(opened.faces)
    closed = printable(opened)
    solid = trimesh.Trimesh(closed.vertices, closed.faces, process=False)
    assert solid.is_watertight
    assert len(np.unique(closed.faces)) == len(used) + 1  # the neck's middle alone is new


def test_the_albedo_is_written_and_the_glb_shows_it_where_wanted(result: Reconstruction, tmp_path: Path) -> None:
    assert result.texturing.atlas is not None
    image = np.full((1024, 1024, 3), (40, 180, 90), np.uint8)
    coefficients = np.arange(27.0).reshape(9, 3)
    albedo = Albedo(Atlas(result.texturing.atlas.layout, image), Light(coefficients, 0.05))
    delit = replace(result, texturing=replace(result.texturing, albedo=albedo))
    pictures = {}
    for name, shown in (("photograph", "file"), ("albedo", "glb")):
        (tmp_path / name).mkdir()
        assert "texture" in written(delit, tmp_path / name, albedo=shown)
        stored = cv2.imread(str(tmp_path / name / "texture" / "albedo.png"))
        np.testing.assert_array_equal(np.asarray(stored)[:, :, ::-1], image)
        loaded = trimesh.load(tmp_path / name / "head.glb", force="mesh", process=False)
        assert isinstance(loaded, trimesh.Trimesh)
        visual: Any = loaded.visual
        pictures[name] = np.asarray(visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert np.abs(pictures["albedo"] - (40, 180, 90)).max() <= 3  # JPEG
    assert np.abs(pictures["photograph"][:, :500] - (200, 30, 30)).max() <= 12
    light: Any = report_document(delit)["texture"]["light"]
    assert light["coefficients"] == coefficients.T.tolist()
    assert report_document(result)["texture"]["light"] is None


def with_sets(result: Reconstruction) -> Reconstruction:
    """Green scattered light, and a surface that mirrors 0.02 of it on the left and 0.3 on the right."""
    assert result.texturing.atlas is not None
    layout = result.texturing.atlas.layout
    green, dark = (np.full((1024, 1024, 3), colour, np.uint8) for colour in ((40, 180, 90), (60, 20, 10)))
    light = np.full((1024, 1024, 3), 0.02, np.float16)
    light[:, 512:] = 0.3
    sets = {"cross": Atlas(layout, green), "parallel": Atlas(layout, dark), "uv": Atlas(layout, dark)}
    specular = Specular(light, {"a": 0.5, "b": 1.0}, 0.1, False)
    return replace(result, texturing=replace(result.texturing, sets=SetTextures(sets, specular)))


def test_texture_sets_are_written_and_the_glb_mirrors_polarised_light(result: Reconstruction, tmp_path: Path) -> None:
    polarised = with_sets(result)
    written(polarised, tmp_path)
    maps = {path.relative_to(tmp_path).as_posix() for path in (tmp_path / "texture").rglob("*") if path.is_file()}
    assert maps == {f"texture/{name}" for name in ("diffuse.png", "diffuse.exr", "specular.png", "specular.exr")} | {
        f"texture/sets/{name}.png" for name in ("cross", "parallel", "uv")
    }
    mirrored = read_exr((tmp_path / "texture" / "specular.exr").read_bytes())
    assert float(mirrored[5, 900, 1]) == pytest.approx(0.3, rel=1e-3)
    scattered = read_exr((tmp_path / "texture" / "diffuse.exr").read_bytes())
    assert float(scattered[5, 5, 1]) == pytest.approx(0.4564, rel=1e-3)  # linear light of code 180
    coded = cv2.imread(str(tmp_path / "texture" / "specular.png"))
    assert np.asarray(coded)[5, 900].tolist() == [149] * 3  # sRGB's code of 0.3
    document, payload = opened_glb((tmp_path / "head.glb").read_bytes())
    assert document["extensionsUsed"] == ["KHR_materials_specular"]
    assert "extensionsRequired" not in document
    material = document["materials"][0]
    index = material["extensions"]["KHR_materials_specular"]["specularTexture"]["index"]
    view = document["bufferViews"][document["images"][document["textures"][index]["source"]]["bufferView"]]
    data = np.frombuffer(payload, np.uint8)[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    strength = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))[:, :, 3]
    assert strength[5, 5] == pytest.approx(128, abs=1)  # half of what glTF's skin mirrors
    assert strength[5, 900] == 255
    loaded: Any = trimesh.load(tmp_path / "head.glb", force="mesh", process=False)
    shown = np.asarray(loaded.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert np.abs(shown - (40, 180, 90)).max() <= 3  # JPEG
    report: Any = report_document(polarised)["texture"].get("sets")
    assert report["names"] == ["cross", "parallel", "uv"]
    assert report["specular"]["exposure"] == {"a": 0.5, "b": 1.0}
    assert report["specular"]["roughness"] == material["pbrMetallicRoughness"]["roughnessFactor"]


def test_the_albedo_alone_asks_for_a_layout_and_wrong_outputs_are_named() -> None:
    assert OutputSettings(formats=("ply",), albedo="file").textured
    assert not OutputSettings(surface="bust", albedo="glb").textured
    with pytest.raises(InputError) as found:
        settings_from_document({"outputs": {"formats": ["glb", "fbx"], "texture_size": 1000}})
    assert len(found.value.faults) == 2
    for name in ("obj", "atlas"):  # of versions before 0.3
        with pytest.raises(InputError, match=f"unknown key 'outputs.{name}'"):
            settings_from_document({"outputs": {name: True}})


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_normal_map_stands_on_fewer_vertices_of_the_same_head(reduced_result: Reconstruction, tmp_path: Path) -> None:
    mapped = reduced_result
    written(mapped, tmp_path)
    document, payload = opened_glb((tmp_path / "head.glb").read_bytes())
    primitive, head = document["meshes"][0]["primitives"][0], head_mesh(mapped)
    rows = document["asset"]["extras"]["rows_of_ply"]
    view = document["bufferViews"][document["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]]
    places = np.frombuffer(payload, "<f4", 3 * len(rows), view["byteOffset"]).reshape(-1, 3)
    np.testing.assert_allclose(places * 1000.0, head.vertices[rows], atol=1e-3)
    assert document["accessors"][primitive["indices"]]["count"] < 3 * 10_500  # the border is kept whole
    assert document["materials"][0]["normalTexture"] == {"index": 1}
    assert len(read_head_ply(tmp_path / "head.ply")[0].vertices) == len(head.vertices)  # it is whole


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", ["jpeg", "png", "webp", "normal map", "morphs"])
def test_the_khronos_validator_has_nothing_to_say(
    kind: str, result: Reconstruction, tmp_path: Path, gltf_validator: Path, request: pytest.FixtureRequest
) -> None:
    assert result.texturing.atlas is not None
    name = "head.glb"
    if kind == "normal map":
        written(with_sets(request.getfixturevalue("reduced_result")), tmp_path, image="webp")
    elif kind == "morphs":
        model, name = load_model(), "posed.glb"
        blendshape_rig = build_blendshape_rig(model, result.head.fit.world_from_head, result.mesh_world, ())
        evidence = replace(result.evidence, blendshape_rig=blendshape_rig)
        settings = Settings(outputs=OutputSettings(morphs=True, neutral=True))
        made = replace(result, evidence=evidence, settings=settings)
        write_result(tmp_path, made, Capture({}), load_template_writers(None, model))
        for other in ("neutral.glb", "head.glb"):
            assert validated(tmp_path / other, gltf_validator) == (0, 0, [])
    else:
        written(result, tmp_path, image=kind)
    assert validated(tmp_path / name, gltf_validator) == (0, 0, [])


def validated(path: Path, validator: Path) -> tuple[int, int, list[Any]]:
    command = ["node", str(validator / "validate.js"), str(path)]
    verdict = json.loads(subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout)
    return verdict["numErrors"], verdict["numWarnings"], verdict["messages"]


@pytest.fixture(scope="session")
def gltf_validator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("validator")
    try:
        command = ["npm", "install", "--no-audit", "--no-fund", "gltf-validator@2.0.0-dev.3.10"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=120)
    except (OSError, subprocess.SubprocessError) as reason:
        pytest.skip(f"gltf-validator cannot be installed: {type(reason).__name__}")
    (folder / "validate.js").write_text(
        "const fs = require('fs'); require('gltf-validator').validateBytes("
        "new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 20})"
        ".then(report => console.log(JSON.stringify(report.issues)));"
    )
    return folder


def maps() -> SkinMaps:
    heights = np.linspace(-0.1, 0.1, 64, dtype=np.float32).reshape(8, 8)
    return SkinMaps(codes_of(heights), np.full((8, 8, 3), (128, 127, 255), np.uint8), (0.5, 0.25), ("a", "b"))


def test_a_program_reads_millimetres_by_what_the_report_says(tmp_path: Path) -> None:
    image = np.zeros((8, 8, 3), np.uint8)
    image[..., 0] = 200
    atlas = Atlas(Layout(np.zeros((3, 2)), np.array([[0, 1, 2]]), np.arange(3)), image)
    write_skin_maps(tmp_path, atlas, maps())
    document = json.loads(json.dumps(skin_document(maps())))
    stored = cv2.imread(str(tmp_path / "displacement.png"), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == np.uint16
    heights = (stored.astype(float) - document["mid_code"]) * document["mm_per_code"]
    np.testing.assert_allclose(heights.ravel(), np.linspace(-0.1, 0.1, 64), atol=2e-5)
    for name, first in (("colour", (0, 0, 200)), ("normals", (255, 127, 128))):  # blue first
        read = cv2.imread(str(tmp_path / f"{name}.png"))
        assert read is not None
        assert tuple(read[0, 0].tolist()) == first
    assert document["repeated"] == [0.5, 0.25]
    assert document["views"] == ["a", "b"]


PLACE = Similarity(1.25, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))
HEAD_MM = {"pronasale": (0.0, -8.0, 90.0), "tragion_left": (70.0, 0.0, 0.0), "vertex": (0.0, 120.0, -5.0)}


@pytest.fixture(scope="module")
def marked() -> Reconstruction:
    deviations = {"pronasale": np.array([0.3, 0.4, 1.2]), "tragion_left": None, "vertex": None}
    landmarks = {
        name: Landmark(PLACE.rotation @ np.array(place) + PLACE.translation, deviations[name])
        for name, place in HEAD_MM.items()
    }
    head = ellipsoid(2)
    fit = Fit("contour", np.array([0.5]), PLACE, 42, "the cost no longer falls")
    settings = settings_from_document({"outputs": {"slicer": True}})
    return made_up_result(Mesh(PLACE.apply(head.vertices), head.faces), fit, landmarks=landmarks, settings=settings)


def test_the_list_is_what_slicers_schema_asks_for(marked: Reconstruction) -> None:
    document = json.loads(json.dumps(landmarks_document(marked), allow_nan=False))
    assert set(document) == {"@schema", "markups"}
    assert document["@schema"].endswith("markups-schema-v1.0.3.json#")
    [markup] = document["markups"]
    assert markup["type"] in ("Fiducial", "Line", "Angle", "Curve", "ClosedCurve", "Plane", "ROI")
    assert (markup["type"], markup["coordinateSystem"], markup["coordinateUnits"]) == ("Fiducial", "LPS", "mm")
    for point in markup["controlPoints"]:
        assert [type(point[key]) for key in ("id", "label", "description", "positionStatus")] == [str] * 4
        assert point["positionStatus"] == "defined"
        assert len(point["position"]) == 3
        assert all(type(value) is float for value in point["position"])
    assert len({point["id"] for point in markup["controlPoints"]}) == len(HEAD_MM)


def test_points_say_how_sure_they_are(marked: Reconstruction) -> None:
    points = {point["label"]: point for point in landmarks_document(marked)["markups"][0]["controlPoints"]}
    assert points["pronasale"]["description"].startswith("standard deviation 1.300 mm;")  # hypot(0.3, 0.4, 1.2)
    assert {points[name]["description"] for name in ("tragion_left", "vertex")} == {"standard deviation unknown"}


def test_the_written_file_leads_back_to_the_reports_landmarks(marked: Reconstruction, tmp_path: Path) -> None:
    write_result(tmp_path, marked, Capture({}))
    report = json.loads((tmp_path / "report.json").read_text())
    place = report["world_from_head"]
    markup = json.loads((tmp_path / "landmarks.mrk.json").read_text())["markups"][0]
    for point in markup["controlPoints"]:
        left, posterior, superior = point["position"]
        head = np.array([left, superior, -posterior])
        world = np.array(place["rotation"]) @ head + place["scale"] * np.array(place["translation"])
        np.testing.assert_allclose(world, report["landmarks"][point["label"]]["position"], atol=1e-6)
    assert RESULT_FILE.match("landmarks.mrk.json")  # so that a second run without it takes it away
