"""A scan wrapped from its file to the files of the result; a template drawn onto it, what lies deeper following."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.applications.templates.placement import Surface
from pipeline.applications.templates.template_file import Template
from pipeline.applications.wrapping.scan import raw_scan, read_raw_scan
from pipeline.applications.wrapping.wrap import (
    PlacedScan,
    deform_onto,
    nearest_axis,
    place_scan,
    residual_colours,
    unit_of,
    wrap,
)
from pipeline.applications.wrapping.write import write_wrapped
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel, load_model
from rig.errors import InputError
from rig.formats.meshes.mesh_file import TexturedMesh, read_mesh
from rig.formats.meshes.polygon_obj import read_polygons
from rig.geometry import rotation_from_vector
from rig.mesh import Mesh
from rig.progress import discard_progress
from tests.support.ready_templates import EYE_CENTRE, ready_template
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


@pytest.fixture(scope="module")
def template(model: HeadModel) -> Template:
    return ready_template(model)


def test_a_template_lies_on_the_scan_it_was_drawn_to(model: HeadModel, template: Template) -> None:
    """The scan is the model's mean with a bump of 3 mm, 20 mm broad, on the crown and on a cheek."""
    mean, faces = model.vertices(np.zeros(0)), model.levels["full"].faces
    scan = Surface.of(mean, faces)
    crown, cheek = mean[mean[:, 1].argmax()], mean[np.linalg.norm(mean - (45.0, -20.0, 60.0), axis=1).argmin()]
    squares = [((mean - at) ** 2).sum(axis=1) for at in (crown, cheek)]
    bump = np.exp(-0.5 * np.array(squares) / 20.0**2).sum(axis=0)
    scan = Surface.of(mean + 3.0 * bump[:, None] * scan.normals, faces)
    carried = template.surface_binding.on(mean, faces)
    drawn, met = deform_onto(carried, template, model, scan)
    index, skin = SurfaceIndex(scan.vertices, scan.faces), template.surface_binding.skin
    before, after = (index.closest(points[skin]).distances for points in (carried, drawn))
    assert before.max() > 2.5
    assert np.median(after) < 0.02
    assert np.percentile(after, 75) < 0.1
    assert met[skin].mean() > 0.9
    ball = drawn[template.surface_binding.wholes == 0]
    assert np.ptp(np.linalg.norm(ball - ball.mean(axis=0), axis=1)) < 0.5  # still round
    assert np.linalg.norm(ball.mean(axis=0) - EYE_CENTRE) < 3.0


def marked_scan(model: HeadModel, factor: float) -> tuple[PlacedScan, np.ndarray]:
    """The mean head in another unit, askew, off the origin, its triangles turned over; placed by its landmarks."""
    turn = rotation_from_vector(np.array([1.2, -0.4, 0.7]))
    mean, faces = model.vertices(np.zeros(0), "p95"), model.levels["p95"].faces
    moved = mean @ turn.T * factor + 3.0
    where = {name: model.vertices(np.zeros(0))[row] @ turn.T * factor + 3.0 for name, row in model.landmarks.items()}
    scan = raw_scan(TexturedMesh(Mesh(moved, np.ascontiguousarray(faces[:, ::-1]))), "scan")
    return place_scan(scan, model, where | {"nobody": np.zeros(3)}), turn


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "mm"), (0.1, "cm"), (0.001, "m"), (0.0043, None)])
def test_landmarks_place_a_scan_in_any_unit(model: HeadModel, factor: float, unit: str | None) -> None:
    placed, turn = marked_scan(model, factor)
    assert placed.unit == unit
    assert placed.mm_per_unit == pytest.approx(1.0 / factor, rel=1e-6)
    assert placed.turned_over
    assert placed.up == nearest_axis(turn[:, 1])
    assert placed.front == nearest_axis(turn[:, 2])
    surface, level = placed.surface(), model.levels["p95"]
    np.testing.assert_allclose(
        surface.vertices[surface.faces], model.vertices(np.zeros(0), "p95")[level.faces], atol=1e-6
    )
    np.testing.assert_allclose(placed.marks.on(model.vertices(np.zeros(0))), placed.marks.points, atol=1e-6)
    with pytest.raises(InputError, match="landmarks"):
        place_scan(
            raw_scan(TexturedMesh(Mesh(surface.vertices, surface.faces)), "scan"), model, {"pronasale": np.zeros(3)}
        )


@pytest.mark.parametrize(
    ("scale", "expected"),
    [(1.1, ("mm", 1.0)), (0.09, ("cm", 10.0)), (0.04, ("in", 25.4)), (0.001, ("m", 1000.0)), (0.5, (None, 2.0))],
)
def test_a_faces_size_tells_the_unit_or_is_a_mean_adults(scale: float, expected: tuple[str | None, float]) -> None:
    assert unit_of(scale) == expected
