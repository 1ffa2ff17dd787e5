"""Nodes at pivots, and eyeballs that turn, read back by another reader."""

import numpy as np
import trimesh
from trimesh.util import wrap_as_stream

from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.scene import Part, Scene
from rig.mesh import Mesh
from tests.support.glb import opened_glb
from tests.support.scenes import ellipsoid

PIVOTS = {
    "jaw": np.array([0.0, 2.0, 11.0]),
    "eye_left": np.array([31.0, 12.0, 70.0]),
    "neck": np.array([0.0, -26, -11]),
}


def written() -> tuple[bytes, Mesh, Mesh]:
    head = ellipsoid(3)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
    eye = Mesh(np.array(ball.vertices) + PIVOTS["eye_left"], np.array(ball.faces, np.int32))
    skin = Part("head", head, morphs={"jawOpen": np.ones_like(head.vertices)})
    scene = Scene([skin, Part("eye_left", eye, pivot="eye_left", rows=[3, 4])], PIVOTS)
    return scene_glb_bytes(scene), head, eye


def test_every_part_lies_where_it_was() -> None:
    glb, head, eye = written()
    scene = trimesh.load_scene(wrap_as_stream(glb), file_type="glb")
    for name, mesh in (("head", head), ("eye_left", eye)):
        place, geometry = scene.graph[name]
        found = trimesh.transform_points(scene.geometry[geometry].vertices, place)
        np.testing.assert_allclose(found.min(axis=0), mesh.vertices.min(axis=0) / 1000.0, atol=1e-6)
        np.testing.assert_allclose(found.max(axis=0), mesh.vertices.max(axis=0) / 1000.0, atol=1e-6)
    for name, pivot in PIVOTS.items():
        np.testing.assert_allclose(scene.graph[name][0][:3, 3], pivot / 1000.0, atol=1e-9)


def test_the_neck_carries_all_others_and_rows_are_told() -> None:
    document, _ = opened_glb(written()[0])
    nodes = {node["name"]: node for node in document["nodes"]}
    root = document["nodes"][document["scenes"][0]["nodes"][0]]
    assert root["name"] == "neck"
    assert {document["nodes"][k]["name"] for k in root["children"]} == {"head", "jaw", "eye_left"}
    assert nodes["eye_left"]["extras"] == {"rows": [3, 4]}
    assert "mesh" not in nodes["jaw"]
    assert document["meshes"][0]["extras"]["targetNames"] == ["jawOpen"]
