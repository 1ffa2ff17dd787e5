"""FLAME models: their files, their surface, and parameters that come back."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.applications.templates.flame_model import FlameModel, FlameParameters, fit_flame, surface_jacobian
from pipeline.applications.templates.header import BadTemplate
from pipeline.applications.templates.make import read_flame
from pipeline.applications.templates.template_file import read_template, save_template
from pipeline.head_model.model import load_model
from rig.errors import InputError
from tests.support.made_up_flame import (
    flame_surface,
    flame_template,
    made_up_flame,
    some_parameters,
    write_archive,
    write_pickle,
)


@pytest.fixture(scope="module")
def arrays() -> dict[str, Any]:
    return made_up_flame()


@pytest.fixture(scope="module")
def model(arrays: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> FlameModel:
    return read_flame(write_archive(tmp_path_factory.mktemp("flame") / "flame.npz", arrays))


def values_of(parameters: dict[str, np.ndarray]) -> FlameParameters:
    pose = np.concatenate([parameters[name].ravel() for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")])
    return FlameParameters(parameters["shape"], parameters["expr"][0], pose.reshape(5, 3), parameters["translation"][0])


def test_the_surface_is_that_of_the_papers_equations(model: FlameModel, arrays: dict[str, Any]) -> None:
    parameters = some_parameters()
    offsets = np.random.default_rng(0).normal(0.0, 1e-3, model.template.shape)
    wanted = flame_surface(arrays, parameters | {"static_offset": offsets[None]})
    np.testing.assert_allclose(model.surface(values_of(parameters), offsets), wanted, atol=1e-12)


def test_the_jacobian_is_that_of_differences(model: FlameModel) -> None:
    value = values_of(some_parameters())
    found = surface_jacobian(model, value)
    for column, step in ((7, 1e-4), (305, 1e-4), (404, 1e-4), (417, 1e-4)):
        vector = np.concatenate([value.shape, value.expression, value.pose.ravel(), value.translation])
        sides = []
        for sign in (1.0, -1.0):
            there = vector.copy()
            there[column] += sign * step
            ends = np.split(there, [300, 400, 415])
            sides.append(model.surface(FlameParameters(ends[0], ends[1], ends[2].reshape(5, 3), ends[3])))
        np.testing.assert_allclose(found[:, :, column], (sides[0] - sides[1]) / (2 * step), atol=1e-8)


def test_parameters_come_back_within_a_hundredth(model: FlameModel, arrays: dict[str, Any]) -> None:
    parameters = some_parameters()
    true, target = values_of(parameters), flame_surface(arrays, parameters)
    fit = fit_flame(model, target)
    for name in ("shape", "expression", "translation"):
        found, wanted = getattr(fit.parameters, name), getattr(true, name)
        assert np.linalg.norm(found - wanted) < 0.01 * np.linalg.norm(wanted), name
    assert (np.linalg.norm(fit.parameters.pose - true.pose, axis=1) < 0.01 * np.linalg.norm(true.pose, axis=1)).all()
    assert fit.distances.max() < 1e-5


def test_what_the_model_cannot_be_becomes_offsets(model: FlameModel, arrays: dict[str, Any]) -> None:
    parameters = some_parameters()
    rough = np.random.default_rng(3).normal(0.0, 5e-4, model.template.shape)
    target = flame_surface(arrays, parameters) + rough
    fit = fit_flame(model, target)
    assert 3e-4 < np.median(fit.distances) < 9e-4
    assert np.linalg.norm(fit.parameters.pose - values_of(parameters).pose, axis=1).max() < 0.03
    np.testing.assert_allclose(model.surface(fit.parameters, fit.offsets), target, atol=1e-9)


@pytest.mark.parametrize("protocol", [2, 4])
def test_pickles_need_no_chumpy(arrays: dict[str, Any], model: FlameModel, tmp_path: Path, protocol: int) -> None:
    read = read_flame(write_pickle(tmp_path / "generic_model.pkl", arrays, protocol))
    for name in ("template", "shape_modes", "expression_modes", "pose_modes", "joint_regressor", "parents", "faces"):
        np.testing.assert_array_equal(getattr(read, name), getattr(model, name))


@pytest.mark.parametrize("module", ["numpy.f2py.diagnose", "os", "chumpy.ch", "scipy.sparse.csc", "copy_reg", "numpy"])
def test_names_of_arrays_programs_are_never_imported(module: str, tmp_path: Path) -> None:
    """``cmodule\\nname``, called with a command: run by pickle itself, each would import the module."""
    (tmp_path / "bad.pkl").write_bytes(f"(dS'f'\nc{module}\nsystem\n(S'touch {tmp_path}/made'\ntRs.".encode())
    with pytest.raises(InputError):
        read_flame(tmp_path / "bad.pkl")
    assert not (tmp_path / "made").exists()


def test_wrong_arrays_are_refused_with_every_fault(arrays: dict[str, Any], tmp_path: Path) -> None:
    missing = {name: value for name, value in arrays.items() if name not in ("weights", "posedirs")}
    with pytest.raises(InputError, match=r"no array posedirs.*no array weights"):
        read_flame(write_archive(tmp_path / "missing.npz", missing))
    unfit = arrays | {"shapedirs": arrays["shapedirs"][:, :, :300], "weights": arrays["weights"][:, :4]}
    with pytest.raises(InputError, match=r"(?s)weights.*shapedirs"):
        read_flame(write_archive(tmp_path / "unfit.npz", unfit))
    broken = arrays | {"v_template": arrays["v_template"] * np.nan, "f": arrays["f"] + 90_000}
    with pytest.raises(InputError, match=r"(?s)v_template contains.*f contains"):
        read_flame(write_archive(tmp_path / "broken.npz", broken))
    (tmp_path / "cut.pkl").write_bytes(pickle.dumps({"f": arrays["f"]}, protocol=2)[:-40])
    with pytest.raises(InputError, match="damaged"):
        read_flame(tmp_path / "cut.pkl")


def test_a_template_keeps_its_flame_model(arrays: dict[str, Any], model: FlameModel, tmp_path: Path) -> None:
    small = replace(model, shape_modes=model.shape_modes[:, :, :9], expression_modes=model.expression_modes[:, :, :4])
    template = flame_template(small, load_model())
    save_template(tmp_path / "flame.npz", template)
    again = read_template(tmp_path / "flame.npz").flame
    assert again is not None
    parameters = replace(values_of(some_parameters()), shape=np.ones(9), expression=np.ones(4))
    np.testing.assert_allclose(again.surface(parameters), small.surface(parameters), atol=1e-6)
    per_vertex = ("template", "shape_modes", "expression_modes", "pose_modes", "weights")
    fewer = {name: getattr(small, name)[1:] for name in per_vertex}
    cut = replace(small, **fewer, joint_regressor=small.joint_regressor[:, 1:])
    save_template(tmp_path / "cut.npz", replace(template, flame=cut))
    with pytest.raises(BadTemplate, match="do not fit"):
        read_template(tmp_path / "cut.npz")
