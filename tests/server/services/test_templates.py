"""Templates as the service's callers see them."""

from pathlib import Path

import pytest

from pipeline.head_model.model_names import DATA
from server.services.templates import templates_at_hand
from tests.support.template_headers import header_file


def test_templates_name_their_models_and_damaged_ones_their_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DATA, str(tmp_path))
    assert templates_at_hand() == []
    header_file(tmp_path, "flame")
    header_file(tmp_path, "lost", model_name="gone", model_sha256="ee" * 32)
    header_file(tmp_path, "wrong").write_bytes(b"PK")
    flame, lost, wrong = templates_at_hand()
    assert (flame.id, flame.model, flame.models) == ("flame", "makehuman-138", ["default", "makehuman-138"])
    assert (flame.vertices, flame.fault) == (5023, None)
    assert flame.registration is not None
    assert flame.registration.off_median_mm == 0.012
    assert (lost.model, lost.models, lost.fault) == ("gone", [], None)
    assert (wrong.model, wrong.models, wrong.registration) == (None, [], None)
    assert wrong.fault is not None
    assert str(tmp_path) not in wrong.fault
