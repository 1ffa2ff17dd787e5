"""A scan wrapped from its file to the files of the result."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.applications.wrapping.scan import read_raw_scan
from pipeline.applications.wrapping.wrap import residual_colours, wrap
from pipeline.applications.wrapping.write import write_wrapped
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import load_model
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.meshes.polygon_obj import read_polygons
from rig.geometry import rotation_from_vector
from rig.progress import discard_progress
from tests.support.ready_templates import ready_template
from tests.support.shared_data import shared


def test_residuals_are_coloured_by_size() -> None:
    colours = residual_colours(np.array([0.0, 0.5, 1.0, 9.0, 0.0]), np.array([True, True, True, True, False]))
    assert colours.tolist() == [[235, 235, 235], [235, 235, 0], [235, 0, 0], [235, 0, 0], [140, 140, 150]]


@pytest.mark.slow
@pytest.mark.gl
def test_a_scan_in_metres_lying_askew_is_wrapped(tmp_path: Path) -> None:
    """A real head in metres, z up, turned, its triangles looking inwards. The template is the model's own 5 % level."""
    truth = read_mesh(shared("data/captures/scan-a.truth/head.ply"))
    turn = rotation_from_vector(np.array([1.9, 0.3, -0.2]))
    moved = truth.vertices @ turn.T / 1000.0 + (2.0, -1.0, 0.5)
    colours = None if truth.colours is None else np.c_[truth.colours, np.full(len(truth.colours), 255, np.uint8)]
    mesh = trimesh.Trimesh(moved, truth.faces[:, ::-1], vertex_colors=colours, process=False)
    mesh.export(tmp_path / "scan.glb")
    model = load_model()
    template = ready_template(model)
    wrapped = wrap(read_raw_scan(tmp_path / "scan.glb"), template, model, report=discard_progress)
    document = write_wrapped(tmp_path / "out", wrapped)
    assert (document["unit"], document["turned_over"]) == ("m", True)
    assert (document["up"], document["front"]) == ("+z", "-y")
    figures = document["figures"]
    assert figures["median_mm"] < 0.1
    assert figures["covered_share"] > 0.6
    read = read_polygons(tmp_path / "out" / "wrapped.obj")
    np.testing.assert_array_equal(read.corners, template.mesh.corners)
    off = SurfaceIndex(moved, truth.faces).closest(read.vertices[wrapped.covered]).distances
    assert np.median(off) * 1000.0 < 0.1
    with np.load(tmp_path / "out" / "residual.npz") as residual:
        np.testing.assert_allclose(residual["distance_mm"], wrapped.distance_mm, rtol=1e-5)
    assert json.loads((tmp_path / "out" / "wrap.json").read_text())["figures"] == figures
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "wrapped.obj", "residual.ply", "residual.npz", "wrap.json", "wrap.png"
    }  # fmt: skip
    known = json.loads(shared("data/captures/scan-a.truth/meta.json").read_text())["landmarks_world"]
    fitted = wrapped.placed.head_from_scan.inverse().apply(wrapped.likeness.vertices)
    for name in ("cheilion_right", "cheilion_left", "gnathion"):  # the models' other landmarks are other places
        expected = np.array(known[name]) / 1000.0 @ turn.T + (2.0, -1.0, 0.5)
        assert np.linalg.norm(fitted[model.landmarks[name]] - expected) * 1000.0 < 4.0
