"""Raw scans: joined along seams, with the colours of their files, and refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals

from pipeline.applications.wrapping.scan import RawScan, raw_scan, read_raw_scan
from rig.errors import InputError
from rig.formats.meshes.mesh_file import TexturedMesh
from rig.mesh import Mesh

RED, GREEN = (200, 0, 0), (0, 220, 0)


def off(colours: np.ndarray, expected: tuple[int, int, int]) -> int:
    """Returns the largest difference of any channel."""
    return int(np.abs(colours.astype(int) - expected).max())


def textured_ball(path: Path) -> None:
    """A ball of 5,120 triangles whose texture is red at the left and green at the right."""
    made = trimesh.creation.icosphere(4)
    uv = np.stack([np.where(made.vertices[:, 0] < 0, 0.2, 0.8), 0.5 + 0.4 * made.vertices[:, 1]], axis=1)
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :32], image[:, 32:] = RED, GREEN
    visual = TextureVisuals(uv=uv, image=Image.fromarray(image))
    trimesh.Trimesh(made.vertices, made.faces, visual=visual, process=False).export(path)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_texture_is_read_at_any_place(suffix: str, tmp_path: Path) -> None:
    textured_ball(tmp_path / f"ball{suffix}")
    scan = read_raw_scan(tmp_path / f"ball{suffix}")
    assert scan.is_coloured
    rows = np.arange(len(scan.mesh.faces))
    middle = scan.mesh.vertices[scan.mesh.faces].mean(axis=1)
    colours = scan.colours_at(rows, np.full((len(rows), 3), 1.0 / 3.0))
    assert off(colours[middle[:, 0] < -0.2], RED) <= 3
    assert off(colours[middle[:, 0] > 0.2], GREEN) <= 3
    drawn = scan.drawable()
    assert len(drawn.faces) >= 100_000
    assert drawn.colours is not None
    assert off(drawn.colours[drawn.vertices[:, 0] < -0.3], RED) <= 3


def split_ball() -> RawScan:
    """A ball whose every triangle has corners of its own, with a colour a corner."""
    made = trimesh.creation.icosphere(3)
    corners = np.asarray(made.vertices[made.faces].reshape(-1, 3), float)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    colours = np.clip(128 + 100 * corners, 0, 255).astype(np.uint8)
    return raw_scan(TexturedMesh(Mesh(corners, np.concatenate([faces, [[0, 0, 1]]]).astype(np.int32), colours)), "ball")


def test_vertices_are_joined_keep_their_colours_and_turn_over_together() -> None:
    scan = split_ball()
    assert len(scan.mesh.vertices) == 642
    assert len(scan.mesh.faces) == len(scan.painted.mesh.faces) == 1280  # the degenerate one is dropped
    rows, weights = np.arange(1280), np.tile([1.0, 0.0, 0.0], (1280, 1))
    expected = 128 + 100 * scan.mesh.vertices[scan.mesh.faces[:, 0]]
    np.testing.assert_allclose(scan.colours_at(rows, weights), expected, atol=1.0)
    turned = scan.turned_over()
    np.testing.assert_allclose(turned.mesh.normals(), -scan.mesh.normals(), atol=1e-9)
    np.testing.assert_array_equal(turned.painted.mesh.faces, scan.painted.mesh.faces[:, ::-1])


def test_what_is_no_scan_is_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ball = trimesh.creation.icosphere(4)
    hole = ball.copy()
    hole.vertices[7] = np.nan
    flat = trimesh.Trimesh(ball.vertices * (1.0, 1.0, 0.0), ball.faces, process=False)
    few = trimesh.creation.box()
    for name, mesh, fault in (
        ("nan.obj", hole, "holds a vertex that is not finite"),
        ("points.ply", trimesh.PointCloud(ball.vertices), "holds no triangles"),
        ("box.ply", few, "has 12 triangles; the scan of a head has at least 1,000"),
        ("flat.ply", flat, "lies in one plane or line"),
    ):
        mesh.export(tmp_path / name)
        with pytest.raises(InputError, match=fault):
            read_raw_scan(tmp_path / name)
    (tmp_path / "empty.ply").write_bytes(b"")
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        read_raw_scan(tmp_path / "empty.ply")
    monkeypatch.setattr("pipeline.applications.wrapping.scan.MAX_TRIANGLES", 5000)
    ball.export(tmp_path / "ball.ply")
    with pytest.raises(InputError, match=r"has 5,120 triangles; at most 5,000 are wrapped: decimate it"):
        read_raw_scan(tmp_path / "ball.ply")
