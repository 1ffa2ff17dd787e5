"""Morph targets of a GLB, read back by a reader of the test's own."""

import json
import struct
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.util import wrap_as_stream

from rig.formats.meshes.glb import glb_bytes
from rig.formats.meshes.morph_glb import with_morphs
from rig.mesh import Mesh
from tests.support.scenes import ellipsoid


@pytest.fixture(scope="module")
def head() -> Mesh:
    return ellipsoid(3)


def morphed(head: Mesh) -> bytes:
    colours = np.full((len(head.vertices), 3), 128, np.uint8)
    bump = np.zeros_like(head.vertices)
    bump[:40] = [1.0, 2.0, -3.0]
    glb = glb_bytes(head, normals=head.normals(), colours=colours)
    return with_morphs(glb, head.vertices, head.faces, {"jawOpen": bump, "tongueOut": 0 * bump}, {"jawOpen": 0.25})


def read(glb: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, length = struct.unpack_from("<4sII", glb)
    assert (magic, version, length) == (b"glTF", 2, len(glb))
    (size,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + size]), glb[28 + size :]


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
    document, payload = read(morphed(head))
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
