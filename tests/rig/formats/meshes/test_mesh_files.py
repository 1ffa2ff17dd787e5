"""Mesh files: trimesh reads what we write, bytes are those of docs/capture-format.md, and damage ends in InputError."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.errors import InputError
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.meshes.ply import ply_bytes, read_head_ply, write_ply
from rig.mesh import Mesh, boundary_edges, face_normals
from tests.support.glb import glb_bytes, obj_bytes, opened_glb

RNG = np.random.default_rng(0)
BALL = trimesh.creation.icosphere(subdivisions=2, radius=90.0)
COLOURS = RNG.integers(0, 256, (len(BALL.vertices), 3), dtype=np.uint8)
MESH = Mesh(np.asarray(BALL.vertices, dtype=float), np.asarray(BALL.faces, dtype=np.int32), COLOURS)
QUALITY = RNG.uniform(0, 2, len(BALL.vertices)).astype(np.float32)
VIEWS = RNG.integers(0, 12, len(BALL.vertices), dtype=np.uint8)
PLY = ply_bytes(MESH, normals=MESH.normals(), colours=COLOURS, quality=QUALITY, views=VIEWS)


def test_normals_of_a_ball_point_outwards() -> None:
    # The five or six facets around a vertex lean up to 11 degrees from the sphere, to all sides; what is left of their
    # mean comes from their unequal areas, 15 % at most.
    directions = MESH.vertices / np.linalg.norm(MESH.vertices, axis=1, keepdims=True)
    assert (MESH.normals() * directions).sum(axis=1).min() > np.cos(np.radians(0.15 * 11.0))
    area = 0.5 * np.linalg.norm(face_normals(MESH.vertices, MESH.faces), axis=1).sum()
    assert area == pytest.approx(BALL.area)


def test_boundary_edges() -> None:
    assert len(boundary_edges(MESH.faces)) == 0
    opened = MESH.faces[1:]
    missing = {(int(a), int(b)) for a, b in zip(MESH.faces[0], np.roll(MESH.faces[0], -1), strict=True)}
    assert {(int(b), int(a)) for a, b in boundary_edges(opened)} == missing


def test_trimesh_reads_our_ply(tmp_path: Path) -> None:
    (tmp_path / "head.ply").write_bytes(PLY)
    loaded = trimesh.load(tmp_path / "head.ply", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    np.testing.assert_array_equal(loaded.vertices, MESH.vertices.astype(np.float32))
    np.testing.assert_array_equal(loaded.faces, MESH.faces)
    np.testing.assert_allclose(loaded.vertex_normals, MESH.normals(), atol=1e-6)
    np.testing.assert_array_equal(read_mesh(tmp_path / "head.ply").colours, COLOURS)
    data = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(data["quality"]), QUALITY)
    np.testing.assert_array_equal(np.ravel(data["views"]), VIEWS)


def test_the_glb_is_well_formed() -> None:
    data = glb_bytes(MESH)
    document, _ = opened_glb(data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (size % 4, kind) == (0, b"JSON")
    payload_size, payload_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (payload_kind, 28 + size + payload_size) == (b"BIN\0", len(data))
    for accessor, view in zip(document["accessors"], document["bufferViews"], strict=True):
        components = {"VEC3": 3, "VEC4": 4, "SCALAR": 1}[accessor["type"]]
        width = {5126: 4, 5125: 4, 5123: 2}[accessor["componentType"]]
        assert view["byteLength"] == accessor["count"] * components * width
        assert view["byteOffset"] % 4 == 0
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    place = document["bufferViews"][attributes["COLOR_0"]]["byteOffset"] + 28 + size
    red = struct.unpack_from("<H", data, place)[0] / 65535
    assert red == pytest.approx(float(linear_from_srgb(np.array(COLOURS[0, 0] / 255.0))), abs=1e-5)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_read_mesh_gives_geometry_and_colours_back(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"head{suffix}"
    with pytest.raises(InputError, match="No such file"):
        read_mesh(path)
    path.write_bytes({".ply": PLY, ".glb": glb_bytes(MESH), ".obj": obj_bytes(MESH)}[suffix])
    again = read_mesh(path)
    unit = 1000.0 if suffix == ".glb" else 1.0
    np.testing.assert_allclose(unit * again.vertices, MESH.vertices, atol=1e-4)
    np.testing.assert_array_equal(again.faces, MESH.faces)
    if suffix != ".glb":  # its colours are linear
        np.testing.assert_array_equal(again.colours, COLOURS)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("head.stl", b"solid"),
        ("empty.ply", b""),
        ("cut.ply", PLY[:2000]),
        ("noise.ply", b"ply\nformat nonsense"),
        ("cut.glb", glb_bytes(MESH)[:300]),
        ("points.obj", b"v 0 0 0\nv 1 0 0\n"),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("zero.obj", b"v 0 0 1\nv 1 0 0\nv 0 1 0\nf 0 1 2\n"),
        ("utf16.obj", b"\xff\xfev\x000\x00 "),  # half a letter
        ("commas.obj", b"v 0,5 0,1 0,2\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("beyond.obj", b"v 0 0 1\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
    ],
)
def test_damage_ends_in_input_error(name: str, data: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=name) as refused:
        read_mesh(tmp_path / name)
    assert not re.search("reshape|unmatched|out of bounds|unexpected length", str(refused.value)), "trimesh's words"


DIALECTS = [(b"", b"\xef\xbb\xbfusemtl a#1\n", 1), (b"\n", b"\r", -1), (b"v ", b"v\t", -1), (b"\nf", b" # note\nf", -1)]


@pytest.mark.parametrize(("old", "new", "times"), DIALECTS)
def test_an_obj_in_another_dialect_is_the_same_mesh(old: bytes, new: bytes, times: int, tmp_path: Path) -> None:
    data = obj_bytes(Mesh(MESH.vertices, MESH.faces))
    (tmp_path / "head.obj").write_bytes(data.replace(old, new, times))
    again = read_mesh(tmp_path / "head.obj")
    np.testing.assert_allclose(again.vertices, MESH.vertices, atol=1e-4)
    np.testing.assert_array_equal(again.faces, MESH.faces)


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    properties = {"normals": MESH.normals(), "colours": COLOURS, "quality": QUALITY, "views": VIEWS}
    with pytest.raises(UnicodeEncodeError):
        write_ply(tmp_path / "head.ply", MESH, **properties, comments=("a comment must be ASCII, é is not",))
    assert list(tmp_path.iterdir()) == []


@given(value=st.floats(0.0, 1.0))
def test_srgb_and_back(value: float) -> None:
    # 1e-4: the two branches of IEC 61966-2-1 meet with a step of 3e-8 in linear light, magnified near black by 12.92
    assert float(srgb_from_linear(linear_from_srgb(np.array(value)))) == pytest.approx(value, abs=1e-4)


def test_srgb_of_the_standard() -> None:
    # mid-grey: 18 % linear light is 46.1 % of the sRGB scale
    assert float(srgb_from_linear(np.array(0.18))) == pytest.approx(0.4613, abs=1e-3)
    np.testing.assert_allclose(linear_from_srgb(np.array([0.0, 1.0])), [0.0, 1.0])


def test_our_reader_gives_what_was_written_and_names_half_a_file(tmp_path: Path) -> None:
    path = tmp_path / "head.ply"
    write_ply(path, MESH, normals=MESH.normals(), colours=COLOURS, quality=QUALITY, views=VIEWS)
    mesh, quality = read_head_ply(path)
    np.testing.assert_array_equal(mesh.vertices, MESH.vertices.astype(np.float32))
    np.testing.assert_array_equal(mesh.faces, MESH.faces)
    np.testing.assert_array_equal(mesh.colours, COLOURS)
    np.testing.assert_array_equal(quality, QUALITY.astype(np.float32))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="bytes of vertices and faces"):
        read_head_ply(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match=r"no head\.ply written by eigenhead"):
        read_head_ply(path)
