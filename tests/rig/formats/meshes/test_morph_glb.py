"""Morph targets of a GLB, read back by a reader of the test's own."""

from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.util import wrap_as_stream

from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.scene import Part, Scene, Skin
from rig.mesh import Mesh
from tests.support.glb import opened_glb
from tests.support.scenes import ellipsoid


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


def test_other_programs_still_read_the_mesh(head: Mesh) -> None:
    scene = trimesh.load(wrap_as_stream(morphed(head)), file_type="glb")
    assert isinstance(scene, trimesh.Scene)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.vertices * 1000.0, head.vertices, atol=1e-3)


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
