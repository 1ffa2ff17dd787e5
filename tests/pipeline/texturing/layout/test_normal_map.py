"""A bumpy ball's normals, known from its formula, against what a viewer makes of its reduced mesh and its map."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import trimesh

from pipeline.texturing.layout.normal_map import ReducedLayout, map_normals, reduce, vertex_tangents
from pipeline.texturing.layout.uv_unwrap import Layout, unwrap
from rig.formats.meshes.scene import Skin
from rig.formats.pictures.images import encode_image
from rig.mesh import Mesh
from tests.support.glb import glb_bytes, opened_glb

RADIUS_MM, BUMP_MM, WAVES = 90.0, 0.5, 24.0


def radius(unit: np.ndarray) -> np.ndarray:
    return RADIUS_MM + BUMP_MM * np.sin(WAVES * unit[:, 0]) * np.cos(WAVES * unit[:, 1])


def true_normals(unit: np.ndarray) -> np.ndarray:
    """Of r(unit): the gradient of |p| - r(p / |p|)."""
    x, y = WAVES * unit[:, 0], WAVES * unit[:, 1]
    slope = BUMP_MM * WAVES * np.stack([np.cos(x) * np.cos(y), -np.sin(x) * np.sin(y), np.zeros(len(unit))], axis=1)
    slope -= np.einsum("nx,nx->n", slope, unit)[:, None] * unit
    normal = unit - slope / radius(unit)[:, None]
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dataclass(frozen=True)
class Ball:
    unit: np.ndarray
    mesh: Mesh
    layout: Layout
    reduced: ReducedLayout


@pytest.fixture(scope="module")
def ball() -> Ball:
    """Open below, as a head at its neck."""
    sphere = trimesh.creation.icosphere(subdivisions=5)
    kept = np.asarray(sphere.vertices)[np.asarray(sphere.faces), 1].min(axis=1) > -0.8
    sphere.update_faces(kept)
    sphere.remove_unreferenced_vertices()
    unit = np.asarray(sphere.vertices) / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    mesh = Mesh(unit * radius(unit)[:, None], np.asarray(sphere.faces, np.int32))
    layout = unwrap(mesh.vertices, mesh.faces)
    return Ball(unit, mesh, layout, reduce(layout, mesh.vertices, np.ones(len(unit)), 916))


def opened(glb: bytes) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """What a viewer reads: attributes and faces, and the normal map (0 to 255)."""
    document, payload = opened_glb(glb)
    primitive = document["meshes"][0]["primitives"][0]

    def array(number: int) -> np.ndarray:
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        return np.frombuffer(payload, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)

    texture = document["textures"][document["materials"][0]["normalTexture"]["index"]]
    view = document["bufferViews"][document["images"][texture["source"]]["bufferView"]]
    data = np.frombuffer(payload, np.uint8, view["byteLength"], view["byteOffset"])
    found = {name: array(number).astype(float) for name, number in primitive["attributes"].items()}
    found["faces"] = array(primitive["indices"]).reshape(-1, 3)
    return found, np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[:, :, ::-1].astype(float)


def written(ball: Ball, size: int = 1024) -> bytes:
    mapped = map_normals(ball.mesh.vertices, true_normals(ball.unit), ball.layout, ball.reduced, size)
    blank = encode_image(".png", np.full((8, 8, 3), 200, np.uint8))
    skin = Skin(mapped.uv, blank, "image/png", normal_map=encode_image(".png", mapped.image), tangents=mapped.tangents)
    return glb_bytes(mapped.mesh, normals=mapped.normals, skin=skin)


def shaded(read: dict[str, np.ndarray], image: np.ndarray, count: int = 20000) -> tuple[np.ndarray, ...]:
    """Places on the reduced mesh (unit vectors from its middle), their normals by the map as glTF's text says, and
    without it."""
    rng = np.random.default_rng(7)
    faces = read["faces"][rng.integers(0, len(read["faces"]), count)]
    shares = rng.dirichlet(np.ones(3), count)
    at = {name: np.einsum("nk,nkx->nx", shares, read[name][faces]) for name in read if name != "faces"}
    size = len(image)
    place = (size * at["TEXCOORD_0"] - 0.5).astype(np.float32)
    codes = cv2.remap(image.astype(np.float32), place[None, :, 0], place[None, :, 1], cv2.INTER_LINEAR)[0]
    local = codes / 255.0 * 2.0 - 1.0
    normal = at["NORMAL"] / np.linalg.norm(at["NORMAL"], axis=1, keepdims=True)
    tangent = at["TANGENT"][:, :3] / np.linalg.norm(at["TANGENT"][:, :3], axis=1, keepdims=True)
    bitangent = np.cross(normal, tangent) * at["TANGENT"][:, 3:]
    turned = local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * normal
    towards = at["POSITION"] / np.linalg.norm(at["POSITION"], axis=1, keepdims=True)
    return towards, turned / np.linalg.norm(turned, axis=1, keepdims=True), normal


def off_deg(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.einsum("nx,nx->n", found, wanted), -1.0, 1.0)))


def test_the_reduced_mesh_shades_as_the_full_one(ball: Ball) -> None:
    read, image = opened(written(ball))
    assert len(read["faces"]) < 0.12 * len(ball.mesh.faces)  # the border is kept whole
    towards, turned, plain = shaded(read, image)
    wanted = true_normals(towards)
    with_map, without = off_deg(turned, wanted), off_deg(plain, wanted)
    assert np.median(without) > 2.0
    assert np.median(with_map) < 0.25 * np.median(without)  # what is left: texels slide by a millimetre on large faces
    # a map with its green or red turned over is no such map: the convention is right, and seen to matter
    for channel in (0, 1):
        wrong = image.copy()
        wrong[:, :, channel] = 255 - wrong[:, :, channel]
        assert np.median(off_deg(shaded(read, wrong)[1], wanted)) > 3.0 * np.median(with_map)


def test_the_cut_stays_closed_and_nothing_turns_over(ball: Ball) -> None:
    rows, faces = ball.layout.source[ball.reduced.rows], ball.reduced.faces
    joined = rows[faces]  # of the mesh before it was cut
    edges = np.sort(np.concatenate([joined[:, [0, 1]], joined[:, [1, 2]], joined[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    rim = trimesh.Trimesh(ball.mesh.vertices, ball.mesh.faces, process=False)
    open_edges = trimesh.grouping.group_rows(rim.edges_sorted, require_count=1)
    assert (count == 1).sum() == len(open_edges)  # the neck alone
    a, b, c = (ball.layout.uv[ball.reduced.rows][faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (area < 0).all()


def test_tangents_point_where_u_grows_and_bitangents_up_in_the_image() -> None:
    """A square that faces z, its image upright: u to the right, v downwards."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    uv, faces = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    found = vertex_tangents(vertices, normals, uv, faces)
    np.testing.assert_allclose(found, np.tile([1.0, 0.0, 0.0, 1.0], (4, 1)), atol=1e-12)
    bitangent = np.cross(normals, found[:, :3]) * found[:, 3:]
    np.testing.assert_allclose(bitangent, np.tile([0.0, 1.0, 0.0], (4, 1)), atol=1e-12)
    mirrored = vertex_tangents(vertices, normals, uv * (-1.0, 1.0) + (1.0, 0.0), faces)
    np.testing.assert_allclose(mirrored, np.tile([-1.0, 0.0, 0.0, -1.0], (4, 1)), atol=1e-12)
