"""The published schemas and the readers judge alike: valid documents, and those with one thing in them changed."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.camera import Camera, Intrinsics
from rig.errors import InputError
from rig.formats.cameras.cameras_json import document_from_rig, rig_from_document
from rig.formats.captures.features_json import features_from_document
from rig.geometry import RigidTransform
from rig.messages.message import Message, texts_of
from rig.recorded_lens import RecordedLens
from rig.rig import Rig

SCHEMAS = Path(__file__).resolve().parents[4] / "docs" / "schemas"
# What no schema can say: of matrices, of several entries together, of a rig that lies in another file.
BEYOND_SCHEMAS = ("orthonormal", "determinant", "semi-definite", "occurs", "which the rig does not have", "outside the")
Place = tuple[str | int, ...]


def judge(name: str) -> Any:
    return jsonschema_rs.validator_for(json.loads((SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8")))


POSE = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1200.0]))
LENS = Intrinsics(1024, 768, 1500.0, 1500.0, 511.5, 383.5)
RECORDED = (None, RecordedLens("kannala-brandt", (0.1, 0.0, 0.0, 0.0)), RecordedLens("rational", (0.1,) * 8))
RIG = Rig(tuple(Camera(f"cam{i:02}", LENS, POSE, np.eye(6) * 1e-6, RECORDED[i]) for i in range(3)))
CAMERAS = json.loads(json.dumps(document_from_rig(RIG)))
FEATURES = {
    "format": "eigenhead-features/1",
    "points": {"pronasale": {"cam00": [511.2, 402.7], "cam01": [433, 398.1]}, "gnathion": {"cam02": [0.5, 700.0]}},
}
JUDGES = {"cameras": judge("cameras"), "features": judge("features")}


def places(node: Any, at: Place = ()) -> Iterator[Place]:
    if at:
        yield at
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield from places(value, (*at, key))


numbers = st.one_of(
    st.integers(-30_000, 30_000),
    st.sampled_from([0, -1, 15, 16, 20_000, 20_001, 10**9, 10**12, 10**13, 0.5, -1e12, 2.0]),
)
values = st.one_of(
    st.none(),
    st.booleans(),
    numbers,
    st.sampled_from(
        ["", "1", "mm", "m", "cam09", ".hidden", "a/b", "ä", "a" * 64, "a" * 65, "fisheye", "rational", "1e3"]
    ),
    st.lists(st.one_of(numbers, st.booleans(), st.sampled_from(["1"])), max_size=7),
    st.sampled_from(
        [{}, {"fx": 1}, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 0], [0, 1]], {"k1": 0.1}, {"cam00": [1, 2]}]
    ),
)


def changed(document: Any, place: Place, what: str, value: Any) -> Any:
    found = copy.deepcopy(document)
    node = found
    for key in place[:-1]:
        node = node[key]
    if what == "set":
        node[place[-1]] = value
    elif what == "drop":
        del node[place[-1]]
    elif isinstance(node, dict):
        node["another"] = value
    else:
        node.append(value)
    return found


def faults_of_cameras(document: Any) -> list[str]:
    try:
        rig_from_document(document)
    except InputError as error:
        return texts_of(error.faults)
    return []


def faults_of_features(document: Any) -> list[str]:
    faults: list[Message] = []
    features_from_document(document, RIG, faults)
    return texts_of(faults)


def agree(name: str, document: Any, faults: list[str]) -> None:
    said = [fault for fault in faults if not any(words in fault for words in BEYOND_SCHEMAS)]
    if JUDGES[name].is_valid(document):
        assert said == []
    else:
        assert faults


@pytest.mark.parametrize(("name", "document"), [("cameras", CAMERAS), ("features", FEATURES)])
def test_both_accept_what_is_right(name: str, document: Any) -> None:
    assert JUDGES[name].is_valid(document)
    assert (faults_of_cameras if name == "cameras" else faults_of_features)(document) == []


actions = st.sampled_from(["set", "set", "drop", "add"])


@settings(max_examples=400)
@given(place=st.sampled_from(list(places(CAMERAS))), what=actions, value=values)
def test_changed_cameras_are_judged_alike(place: Place, what: str, value: Any) -> None:
    document = changed(CAMERAS, place, what, value)
    agree("cameras", document, faults_of_cameras(document))


@settings(max_examples=300)
@given(place=st.sampled_from(list(places(FEATURES))), what=actions, value=values)
def test_changed_features_are_judged_alike(place: Place, what: str, value: Any) -> None:
    document = changed(FEATURES, place, what, value)
    agree("features", document, faults_of_features(document))
