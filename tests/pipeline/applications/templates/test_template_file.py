"""Templates as files, by name, and in results."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.applications.templates.carrying import bind_vertices, surface_binding
from pipeline.applications.templates.header import (
    BadTemplate,
    OtherModel,
    UnknownTemplate,
    WrongName,
    check_template,
    list_templates,
    new_path,
    read_header,
    remove_template,
)
from pipeline.applications.templates.template_file import Template, load_template, read_template, save_template
from pipeline.applications.templates.write.mesh import write_template
from pipeline.head_model.model import HeadModel
from pipeline.head_model.model_names import DATA, UnknownModel, model_path
from pipeline.settings import Settings, settings_from_document
from pipeline.texturing.layout.uv_unwrap import Atlas, model_layout
from rig.errors import InputError
from rig.formats.meshes.polygon_obj import PolygonMesh, read_polygons
from rig.mesh import Mesh
from tests.support.made_up_results import PLACE, textured_result
from tests.support.template_headers import FIGURES, header_file


@pytest.fixture
def template(model: HeadModel) -> Template:
    """The 1 % level: its uv is x and y over the face, the left half in the next tile; the back has none."""
    level, full = model.levels["p99"], model.levels["full"]
    mean = model.vertices(np.zeros(0))
    rest = mean[level.rows]
    normals = Mesh(mean, full.faces).normals()[level.rows]
    attachment, _, _ = bind_vertices(rest, normals, mean, full.faces)
    carried = surface_binding(rest, np.arange(level.count), attachment, np.full(level.count, -1))
    uv = (rest[:, :2] - rest[:, :2].min(axis=0)) / np.ptp(rest[:, :2], axis=0) * (2.0, 1.0)
    corners = level.faces.ravel().astype(np.int32)
    front = np.repeat((rest[level.faces, 2] > 20).all(axis=1), 3)
    named = ((0, "g head"), (0, "usemtl left"), (len(level.faces) // 2, "usemtl right"))
    mesh = PolygonMesh(rest, np.full(len(level.faces), 3, np.int32), corners, uv, np.where(front, corners, -1), named)
    return Template(
        name="low",
        source="low.obj",
        source_sha256="cd" * 32,
        model_name=model.name,
        model_sha256=model.sha256,
        mesh=mesh,
        surface_binding=carried,
        figures={"vertices": float(level.count)},
    )


def test_a_template_comes_back_and_a_damaged_file_is_told(template: Template, tmp_path: Path) -> None:
    path = tmp_path / "low.npz"
    save_template(path, template)
    again = read_template(path)
    assert (again.name, again.model_sha256, again.figures) == ("low", template.model_sha256, dict(template.figures))
    assert again.mesh.statements == template.mesh.statements
    np.testing.assert_array_equal(again.mesh.corners, template.mesh.corners)
    np.testing.assert_allclose(
        again.surface_binding.attachment.weights, template.surface_binding.attachment.weights, atol=1e-7
    )
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(BadTemplate, match=r"template add FILE.obj --name low --overwrite"):
        read_template(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(BadTemplate, match="does not carry"):
        read_template(path)
    wrong = replace(template.surface_binding, skin=template.surface_binding.skin + 1)
    save_template(path, replace(template, surface_binding=wrong))
    with pytest.raises(BadTemplate, match="vertices that it does not have"):
        read_template(path)


def test_templates_have_names_and_one_model(
    template: Template, model: HeadModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DATA, str(tmp_path))
    assert (list_templates(), load_template(None, model)) == ({}, None)
    save_template(new_path("low"), template)
    assert list(list_templates()) == ["low"]
    assert load_template("low", model) is not None
    with pytest.raises(OtherModel, match=r"--model other"):
        load_template("low", replace(model, name="other", sha256="00" * 32, _bases={}))
    with pytest.raises(UnknownTemplate, match="known are low"):
        load_template("high", model)
    assert remove_template("low") == new_path("low")
    assert list_templates() == {}


@pytest.mark.parametrize("name", ["../../etc/passwd", "", ".hidden", "a b", "x" * 41, "naïve", "a\n"])
def test_a_name_that_would_leave_the_folder_is_refused(name: str) -> None:
    with pytest.raises(WrongName):
        new_path(name)
    with pytest.raises(InputError, match=r"outputs\.template"):
        settings_from_document({"outputs": {"template": name}})


@pytest.mark.slow
def test_a_result_has_the_templates_order_and_texture(template: Template, model: HeadModel, tmp_path: Path) -> None:
    layout, level = model_layout(model).layout, model.levels["p99"]
    image = np.zeros((1024, 1024, 3), np.uint8)
    image[..., 0], image[..., 1] = np.linspace(0, 255, 1024)[None, :], np.linspace(0, 255, 1024)[:, None]
    head = Mesh(model.vertices(np.full(10, 0.5)), model.levels["full"].faces)
    result = replace(
        textured_result(head, Atlas(layout, image)), settings=Settings(), model_sha256=template.model_sha256
    )
    write_template(tmp_path, result, template)
    assert {path.name for path in tmp_path.iterdir()} == {
        "head-low.obj", "head-low.mtl", "head-low.jpg", "head-low-1002.jpg"
    }  # fmt: skip
    written = read_polygons(tmp_path / "head-low.obj")
    np.testing.assert_allclose(written.vertices, PLACE.apply(head.vertices[level.rows]), atol=1e-3)
    np.testing.assert_array_equal(written.corner_uv, template.mesh.corner_uv)
    assert written.statements == template.mesh.statements
    materials = (tmp_path / "head-low.mtl").read_text()
    assert materials.count("newmtl") == 2
    assert "map_Kd head-low" in materials
    tiles = [np.asarray(cv2.imread(str(tmp_path / name))) for name in ("head-low.jpg", "head-low-1002.jpg")]
    # a vertex of the template shows what the model's texture has at that vertex
    front = np.flatnonzero(template.surface_binding.rest[:, 2] > 40)
    off = []
    u, v = template.mesh.uv[front].T
    place = {int(row): k for k, row in enumerate(layout.source)}
    for k, (x, y) in zip(front, zip(u, v, strict=True), strict=True):
        tile = int(min(x, 1.999))
        column, row = int((x - tile) * 1023), int((1 - y) * 1023)
        wanted = layout.uv[place[int(level.rows[k])]]
        shown = tiles[tile][row, column, ::-1].astype(float) / 255.0
        off.append(np.abs(shown[:2] - wanted).max())
    assert np.median(off) < 0.01  # two codes of 255, and a texel's neighbour; nostrils and ears overlap in this uv


def test_without_a_texture_vertices_have_their_colours(template: Template, model: HeadModel, tmp_path: Path) -> None:
    head = Mesh(model.vertices(np.zeros(0)), model.levels["full"].faces)
    result = replace(textured_result(head, None), model_sha256=template.model_sha256)  # type: ignore[arg-type]
    write_template(tmp_path, result, template)
    assert [path.name for path in tmp_path.iterdir()] == ["head-low.obj"]
    first = next(line for line in (tmp_path / "head-low.obj").read_text().splitlines() if line.startswith("v "))
    np.testing.assert_allclose([float(word) for word in first.split()[4:]], 120 / 255, atol=1e-4)


def test_a_header_is_read_without_the_mesh_and_damage_is_told(tmp_path: Path) -> None:
    path = header_file(tmp_path, "flame")
    header = read_header(path)
    assert (header.name, header.source, header.source_sha256) == ("flame", "flame.obj", "cd" * 32)
    assert header.figures == FIGURES
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(BadTemplate, match="damaged or incomplete"):
        read_header(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(BadTemplate, match="does not carry"):
        read_header(path)
    with pytest.raises(BadTemplate, match="format is 'eigenhead-template/9'"):
        read_header(header_file(tmp_path, "flame", format="eigenhead-template/9"))
    with pytest.raises(BadTemplate, match="No such file"):
        read_header(tmp_path / "none.npz")


def test_a_job_may_use_a_template_of_its_model_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DATA, str(tmp_path))
    header_file(tmp_path, "flame")
    model_file = tmp_path / "own.npz"
    model_file.write_bytes(model_path("default").read_bytes())
    check_template(None, "default")
    for model in ("default", "makehuman-138", str(model_file)):
        check_template("flame", model)  # told by its content
    model_file.write_bytes(model_file.read_bytes() + b"\n")
    with pytest.raises(OtherModel, match="registered to the model 'makehuman-138'"):
        check_template("flame", str(model_file))
    with pytest.raises(UnknownTemplate, match="known are flame"):
        check_template("ict", "default")
    for name in (None, "flame"):
        with pytest.raises(UnknownModel, match="'nobody'"):
            check_template(name, "nobody")
