"""What a job is asked for, and what is refused of it."""

from pathlib import Path

import pytest

from pipeline.head_model.model_names import DATA, model_path
from rig.errors import InputError
from rig.messages.message import Message
from server.services.work import ReconstructionRequest
from tests.support.template_headers import header_file


@pytest.fixture(autouse=True)
def _data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A template of the default model, a damaged one, and another model."""
    monkeypatch.setenv(DATA, str(tmp_path))
    header_file(tmp_path, "flame")
    header_file(tmp_path, "damaged").write_bytes(b"PK")
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "other.npz").write_bytes(model_path("default").read_bytes() + b"\n")


def refusal_of(model: str | None = None, **settings: object) -> tuple[str, tuple[Message, ...]]:
    with pytest.raises(InputError) as refused:
        ReconstructionRequest(model, settings).check()
    return refused.value.subject, refused.value.faults


def test_what_can_be_done_is_not_refused() -> None:
    ReconstructionRequest().check()
    ReconstructionRequest("makehuman-138", {"outputs": {"template": "flame"}}).check()
    ReconstructionRequest("other", {"outputs": {"template": None}}).check()


def test_every_fault_is_named_at_once() -> None:
    subject, faults = refusal_of("nobody", metod="contour", outputs={"template": "ict", "formats": ["xyz"]})
    assert subject == "request"
    for part in ("model: 'nobody' is not at hand", "metod", "'xyz' is none of", "no template 'ict'"):
        assert any(part in fault.text for fault in faults), (part, faults)
    assert len(faults) == 4
    _, faults = refusal_of(outputs={"template": "../x"})
    assert len(faults) == 1
    assert "is no name" in faults[0].text
    _, faults = refusal_of(outputs={"template": 3})
    assert len(faults) == 1
