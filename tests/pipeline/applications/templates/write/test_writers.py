"""flame_param.npz of a made-up result: the parameters make its head, in its world, in metres."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.applications.templates.make import read_flame
from pipeline.applications.templates.write.writers import template_writers
from pipeline.contour_fit.fit import Fit
from pipeline.head_model.model import load_model
from pipeline.results.write import write_result
from pipeline.settings import OutputSettings, Settings
from rig.capture import Capture
from rig.formats.meshes.polygon_obj import read_polygons
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from tests.support.made_up_flame import flame_surface, flame_template, made_up_flame, write_archive
from tests.support.made_up_results import made_up_result

PLACE = Similarity(1.1, rotation_from_vector(np.array([0.1, -2.3, 0.05])), np.array([1200.0, -700.0, 300.0]))


def test_the_parameters_make_the_written_head(tmp_path: Path) -> None:
    model, arrays = load_model(), made_up_flame()
    head = Mesh(PLACE.apply(model.vertices(np.full(5, 0.7))), model.levels["full"].faces)
    template = flame_template(read_flame(write_archive(tmp_path / "flame.npz", arrays)), model)
    result = made_up_result(head, Fit("contour", np.zeros(5), PLACE, 42, "the cost no longer falls"))
    outputs = OutputSettings(surface="head", formats=("ply",), template="flame")
    write_result(tmp_path, replace(result, settings=Settings(outputs=outputs)), Capture({}), template_writers(template))
    with np.load(tmp_path / "flame_param.npz") as file:
        parameters = dict(file)
    assert {name: array.shape for name, array in parameters.items()} == {
        "shape": (300,), "expr": (1, 100), "rotation": (1, 3), "neck_pose": (1, 3), "jaw_pose": (1, 3),
        "eyes_pose": (1, 6), "translation": (1, 3), "static_offset": (1, len(arrays["v_template"]), 3),
    }  # fmt: skip
    assert all(array.dtype == np.float32 for array in parameters.values())
    written = read_polygons(tmp_path / "head-flame.obj").vertices
    np.testing.assert_allclose(flame_surface(arrays, parameters) * 1000.0, written, atol=0.01)
    without = {name: array for name, array in parameters.items() if name != "static_offset"}
    off = np.linalg.norm(flame_surface(arrays, without) * 1000.0 - written, axis=1)
    report = json.loads((tmp_path / "report.json").read_text())["template"]["flame"]
    skin = template.surface_binding.skin
    np.testing.assert_allclose(report["residual_median_mm"], np.median(off[skin]), atol=0.01)
    np.testing.assert_allclose(report["residual_p95_mm"], np.percentile(off[skin], 95), atol=0.02)
    assert report["residual_median_mm"] < 1.0
