"""OBJ files with their polygons: what is read is what is written, and every fault is named."""

import time
from pathlib import Path

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.meshes import polygon_obj
from rig.formats.meshes.polygon_obj import PolygonMesh, polygon_obj_bytes, read_polygons

HOUSE = """# a quad, a pentagon across two lines and a triangle that counts backwards
v 0 0 0
v 1 0 0 0.5 0.5 0.5
v 1 1 0
v 0 1 0
v 0.5 1.5 0
vt 0 0
vt 1 0
vt 1 1
vt 0.25
g walls
usemtl brick
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl tiles
f 1//1 2//1 3//1 \\
  5//1 4//1
f -3/1 -1/2 -2/3
"""


def read(folder: Path, text: str) -> PolygonMesh:
    (folder / "mesh.obj").write_text(text)
    return read_polygons(folder / "mesh.obj")


def test_polygons_seams_groups_and_order_come_back(tmp_path: Path) -> None:
    mesh = read(tmp_path, HOUSE)
    assert mesh.vertices.shape == (5, 3)
    assert mesh.sizes.tolist() == [4, 5, 3]
    assert mesh.corners.tolist() == [0, 1, 2, 3, 0, 1, 2, 4, 3, 2, 4, 3]
    assert mesh.corner_uv.tolist() == [0, 1, 2, 3, *[-1] * 5, 0, 1, 2]
    assert mesh.uv[3].tolist() == [0.25, 0.0]
    assert mesh.statements == ((0, "g walls"), (0, "usemtl brick"), (1, "usemtl tiles"))
    moved = mesh.vertices + (0.0, 0.0, 2.5)
    again = read(tmp_path, polygon_obj_bytes(mesh, moved, np.ones((5, 3)), comments=["unit mm"]).decode())
    np.testing.assert_allclose(again.vertices, moved, atol=5e-5)
    for name in ("sizes", "corners", "uv", "corner_uv"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    assert again.statements == mesh.statements
    triangles = mesh.triangles()  # fans that cover each polygon once
    a, b, c = (mesh.vertices[triangles[:, k]] for k in range(3))
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3], [2, 4, 3]]
    np.testing.assert_allclose([area[:2].sum(), area[2:5].sum(), area[5]], [1.0, 1.25, 0.25])


def test_every_fault_of_a_file_is_named(tmp_path: Path) -> None:
    broken = "v 0 0 nan\nv 1 0\nv a b c\nv 0 1 0\nvt inf 0\nf 1 2\nf 1 2 0\nf 1 2 99\nf 1/5 2/1 3/1\nf x y z\n"
    with pytest.raises(InputError) as refused:
        read(tmp_path, broken)
    message = str(refused.value)
    for word in (*(f"line {line}:" for line in (1, 2, 3, 5, 6, 7, 10)), "vertex 99", "coordinate 5"):
        assert word in message, word
    for text, word in (("", "no vertices"), ("v 0 0 0\n", "no faces"), ("f 1/1 2/1 3/1\nv 0 0 0\n", "are none")):
        with pytest.raises(InputError, match=word):
            read(tmp_path, text)
    with pytest.raises(InputError, match="lines more"):
        read(tmp_path, "v x y z\n" * 50)


@pytest.mark.parametrize("corners", ["1 2 3", "0 0 0", "-9 x /"], ids=["right", "strange", "wrong"])
def test_a_face_of_six_million_corners_is_one_sentence(tmp_path: Path, corners: str) -> None:
    """Nobody looks at each corner: that takes fifty times the seconds in which the text is cut into words."""
    text, began_s = "v 0 0 0\nv 1 0 0\nf " + f"{corners} " * 2_000_000 + "\nf 1 2 1\n", time.thread_time()
    assert len(text.split()) > 6_000_000
    cut_s, began_s = time.thread_time() - began_s, time.thread_time()
    with pytest.raises(InputError, match="line 3: a polygon of more than 4096 corners") as refused:
        read(tmp_path, text)
    assert time.thread_time() - began_s < 5.0 * cut_s
    assert "more" not in str(refused.value).replace("more than 4096", "")


def test_what_is_too_large_is_not_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polygon_obj, "MOST_VERTICES", 10)
    with pytest.raises(InputError, match="decimate") as refused:
        read(tmp_path, "v 0 0 0\n" * 11 + "v what comes after is not looked at\n")
    assert "line 12" not in str(refused.value)
    monkeypatch.setattr(polygon_obj, "MOST_BYTES", 20)
    with pytest.raises(InputError, match="MB large"):
        read(tmp_path, "v 0 0 0\n" * 11)
    with pytest.raises(InputError, match="cannot be read"):
        read_polygons(tmp_path / "nowhere.obj")
