"""What a template's file says of itself, and whether a job may use it."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.templates.header import BadTemplate, OtherModel, check_template, read_header
from pipeline.applications.templates.names import UnknownTemplate
from pipeline.head_model.data_folder import DATA
from pipeline.head_model.model_names import UnknownModel, model_path
from tests.support.template_headers import FIGURES, header_file


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
    with pytest.raises(BadTemplate, match="format 'eigenhead-template/9'"):
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
