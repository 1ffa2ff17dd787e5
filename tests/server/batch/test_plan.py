"""What a batch is to make, and every wrong setting before anything is made."""

import json
from pathlib import Path
from types import MappingProxyType

import pytest

from pipeline.applications.templates.header import UnknownTemplate
from pipeline.head_model.model_names import UnknownModel, model_path, model_sha256
from pipeline.settings import document_from_settings, settings_from_document
from rig.errors import InputError
from server.batch.captures import BatchCapture
from server.batch.plan import plan_batch


def capture(name: str, **settings: object) -> BatchCapture:
    return BatchCapture(name, Path(name), settings=MappingProxyType(settings))


def test_a_captures_own_settings_go_over_those_of_the_batch() -> None:
    base = {"detail": "photo", "outputs": {"surface": "head"}}
    anna, bert = plan_batch([capture("anna"), capture("bert", outputs={"neutral": True})], base, None)
    assert settings_from_document(anna.settings).outputs.surface == "head"
    chosen = settings_from_document(bert.settings)
    assert (chosen.detail, chosen.outputs.surface, chosen.outputs.neutral) == ("photo", "head", True)
    assert anna.settings_sha256 != bert.settings_sha256
    assert anna.model_sha256 == model_sha256(model_path("default"))
    assert sum(anna.expected_s.values()) > 0


def test_the_hash_is_of_what_the_settings_mean() -> None:
    """A default that is written out is the same; so are lists and tuples."""
    plain, written = plan_batch([capture("a"), capture("b", method="contour", fail_on=[])], {}, None)
    assert plain.settings_sha256 == written.settings_sha256
    again = document_from_settings(settings_from_document(json.loads(json.dumps(plain.settings))))
    assert again == plain.settings


def test_what_is_wrong_for_all_is_said_once() -> None:
    captures = [capture(f"c{k}") for k in range(50)]
    with pytest.raises(InputError) as caught:
        plan_batch(captures, {"detial": "photo"}, None)
    assert len(caught.value.faults) == 1
    with pytest.raises(UnknownTemplate):
        plan_batch(captures, {"outputs": {"template": "nobody"}}, None)
    with pytest.raises(UnknownModel):
        plan_batch(captures, {}, "no-such-model")
