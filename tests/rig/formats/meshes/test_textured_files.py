"""Textured and printable meshes: other programs read what we write, and the same input is the same bytes."""

import io
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import trimesh

from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.ply import ply_bytes, read_head_ply
from rig.formats.meshes.polygon_obj import mtl_bytes, scene_obj_bytes
from rig.formats.meshes.printing import stl_bytes, threemf_bytes
from rig.formats.meshes.scene import Part, Scene, Skin
from rig.formats.meshes.usdz import scene_usdz_bytes
from rig.mesh import Mesh
from tests.support.glb import glb_bytes, opened_glb
from tests.support.scenes import ellipsoid

BALL = trimesh.creation.icosphere(subdivisions=2, radius=90.0)
MESH = Mesh(np.asarray(BALL.vertices, dtype=float), np.asarray(BALL.faces, dtype=np.int32))
NORMALS = MESH.normals()
UV = np.random.default_rng(0).uniform(0, 0.5, (len(MESH.vertices), 2))
PICTURE = np.full((64, 64, 3), (10, 40, 200), np.uint8)
PICTURE[32:] = 90  # the lower half, v > 0.5


def image(suffix: str) -> bytes:
    return cv2.imencode(suffix, PICTURE)[1].tobytes()


@pytest.mark.parametrize(("suffix", "mime"), [(".jpg", "image/jpeg"), (".png", "image/png"), (".webp", "image/webp")])
def test_trimesh_reads_a_textured_glb(suffix: str, mime: str) -> None:
    extras = {"version": "1", "unit": "m"}
    data = glb_bytes(MESH, normals=NORMALS, skin=Skin(UV, image(suffix), mime), extras=extras)
    loaded = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    visual: Any = loaded.visual
    np.testing.assert_allclose(loaded.vertices * 1000, MESH.vertices, atol=1e-4)
    np.testing.assert_allclose(visual.uv, UV * (1, -1) + (0, 1), atol=1e-6)  # trimesh's v is upwards
    header, _ = opened_glb(data)
    assert header["asset"]["extras"] == extras
    assert header["images"][0]["mimeType"] == mime
    assert ("EXT_texture_webp" in header.get("extensionsRequired", [])) == (suffix == ".webp")
    assert header["meshes"][0]["primitives"][0]["attributes"].keys() == {"POSITION", "NORMAL", "TEXCOORD_0"}
    assert "normalTexture" not in header["materials"][0]
    assert 0 < header["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] < 1


def test_trimesh_reads_a_textured_obj_with_its_material(tmp_path: Path) -> None:
    data = scene_obj_bytes(Scene([Part("head", MESH, NORMALS, Skin(UV, b"", "image/png"))]), "head.mtl")
    (tmp_path / "head.obj").write_bytes(data)
    (tmp_path / "head.mtl").write_bytes(mtl_bytes("head.png"))
    (tmp_path / "head.png").write_bytes(image(".png"))
    loaded = trimesh.load(tmp_path / "head.obj", force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    visual: Any = loaded.visual
    np.testing.assert_allclose(loaded.triangles, MESH.vertices[MESH.faces], atol=1e-3)
    np.testing.assert_allclose(visual.uv[loaded.faces], (UV * (1, -1) + (0, 1))[MESH.faces], atol=1e-5)
    assert visual.material.image.size == (64, 64)
    assert data.count(b"\nvn ") == len(MESH.vertices)


def test_trimesh_reads_texture_coordinates_of_a_ply_and_we_its_mesh(tmp_path: Path) -> None:
    count = len(MESH.vertices)
    attributes = {
        "colours": np.zeros((count, 3), np.uint8),
        "quality": np.ones(count),
        "views": np.ones(count, np.uint8),
    }
    data = ply_bytes(MESH, normals=NORMALS, corner_uv=UV[MESH.faces], comments=["TextureFile head.png"], **attributes)
    (tmp_path / "head.ply").write_bytes(data)
    (tmp_path / "head.png").write_bytes(image(".png"))
    loaded = trimesh.load(tmp_path / "head.ply", force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    visual: Any = loaded.visual
    assert visual.kind == "texture"
    np.testing.assert_allclose(visual.uv[loaded.faces], (UV * (1, -1) + (0, 1))[MESH.faces], atol=1e-6)
    mesh, _ = read_head_ply(tmp_path / "head.ply")
    np.testing.assert_array_equal(mesh.faces, MESH.faces)


def test_stl_and_3mf_hold_the_closed_mesh() -> None:
    loaded = trimesh.load(io.BytesIO(stl_bytes(MESH)), file_type="stl")
    assert isinstance(loaded, trimesh.Trimesh)
    assert loaded.is_watertight
    assert loaded.volume == pytest.approx(BALL.volume, rel=1e-5)
    data = threemf_bytes(MESH)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        root = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
        assert {"[Content_Types].xml", "_rels/.rels"} < {*archive.namelist()}
    space = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    assert root.get("unit") == "millimeter"
    vertices = [[float(node.get(axis, "")) for axis in "xyz"] for node in root.iter(space + "vertex")]
    faces = [[int(node.get(corner, "")) for corner in ("v1", "v2", "v3")] for node in root.iter(space + "triangle")]
    np.testing.assert_allclose(vertices, MESH.vertices, atol=6e-5)
    np.testing.assert_array_equal(faces, MESH.faces)
    assert data == threemf_bytes(MESH)


def test_openusd_reads_the_usdz(tmp_path: Path) -> None:
    pxr: Any = pytest.importorskip("pxr.Usd")
    UsdGeom: Any = pytest.importorskip("pxr.UsdGeom")
    UsdShade: Any = pytest.importorskip("pxr.UsdShade")

    scene = Scene([Part("head", MESH, NORMALS, Skin(UV, image(".jpg")))])
    data = scene_usdz_bytes(scene)
    assert data == scene_usdz_bytes(scene)
    path = tmp_path / "head.usdz"
    path.write_bytes(data)
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            start = entry.header_offset + 30 + len(entry.filename) + len(entry.extra)
            assert (entry.compress_type, start % 64) == (zipfile.ZIP_STORED, 0)
    stage = pxr.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/person/head"))
    np.testing.assert_allclose(np.array(shape.GetPointsAttr().Get()) * 1000, MESH.vertices, atol=1e-4)
    coordinates = UsdGeom.PrimvarsAPI(shape).GetPrimvar("st")
    np.testing.assert_allclose(
        np.array(coordinates.ComputeFlattened()), (UV * (1, -1) + (0, 1))[MESH.faces].reshape(-1, 2), atol=1e-6
    )
    material, _ = UsdShade.MaterialBindingAPI(shape.GetPrim()).ComputeBoundMaterial()
    assert material.GetPath() == "/person/head_skin"
    picture = UsdShade.Shader(stage.GetPrimAtPath("/person/head_skin/texture"))
    assert picture.GetInput("file").Get().resolvedPath.endswith("[head.jpg]")


@pytest.fixture(scope="module")
def head() -> Mesh:
    return ellipsoid(3)


def morphed(head: Mesh, skin: Skin | None = None) -> bytes:
    bump = np.zeros_like(head.vertices)
    bump[:40] = [1.0, 2.0, -3.0]
    morphs = {"jawOpen": bump, "tongueOut": 0 * bump}
    return scene_glb_bytes(Scene([Part("head", head, skin=skin, morphs=morphs, weights={"jawOpen": 0.25})]))


def accessor(document: dict[str, Any], payload: bytes, number: int) -> np.ndarray:
    one = document["accessors"][number]
    out = np.zeros((one["count"], 3))
    if "sparse" in one:
        sparse = one["sparse"]
        places = [document["bufferViews"][sparse[part]["bufferView"]]["byteOffset"] for part in ("indices", "values")]
        rows = np.frombuffer(payload, "<u4", sparse["count"], places[0])
        assert (np.diff(rows.astype(int)) > 0).all()  # as the specification wants
        out[rows] = np.frombuffer(payload, "<f4", 3 * sparse["count"], places[1]).reshape(-1, 3)
    return out


def test_a_morph_moves_what_it_says(head: Mesh) -> None:
    document, payload = opened_glb(morphed(head))
    mesh = document["meshes"][0]
    assert mesh["extras"]["targetNames"] == ["jawOpen", "tongueOut"]
    assert mesh["weights"] == [0.25, 0.0]
    jaw, tongue = (accessor(document, payload, target["POSITION"]) for target in mesh["primitives"][0]["targets"])
    np.testing.assert_allclose(jaw[:40], np.tile([0.001, 0.002, -0.003], (40, 1)), atol=1e-8)
    assert not jaw[40:].any()
    assert not tongue.any()
    bounds = document["accessors"][mesh["primitives"][0]["targets"][0]["POSITION"]]
    np.testing.assert_allclose([bounds["min"], bounds["max"]], [[0, 0, -0.003], [0.001, 0.002, 0]], atol=1e-8)
    turned = head.normals() + accessor(document, payload, mesh["primitives"][0]["targets"][0]["NORMAL"])
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=2e-3)
    assert document["buffers"][0]["byteLength"] == len(payload)


def test_a_vertex_on_a_seam_moves_as_its_twin(head: Mesh) -> None:
    count = len(head.vertices)
    source = np.append(np.arange(count), 3)
    faces = head.faces.copy()
    row, corner = np.argwhere(faces == 3)[0]
    faces[row, corner] = count
    skin = Skin(np.zeros((count + 1, 2)), b"\x89PNG\r\n", "image/png", source, faces)
    document, payload = opened_glb(morphed(head, skin))
    target = document["meshes"][0]["primitives"][0]["targets"][0]
    for kind in ("POSITION", "NORMAL"):
        moved = accessor(document, payload, target[kind])
        np.testing.assert_array_equal(moved[count], moved[3])
    assert "TEXCOORD_0" in document["meshes"][0]["primitives"][0]["attributes"]
