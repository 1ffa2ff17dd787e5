"""Every operation of the service's own description, as generators of clients read it."""

import re
from typing import Any

import jsonschema_rs
import pytest

from server.http.app import create_app
from server.http.routes.operations import DOCS
from server.settings import ServiceSettings

NO_BODY = {"204", "206", "304", "307"}
TUS_BODILESS = {"tus_create", "tus_head"}  # the protocol's answers are headers alone


@pytest.fixture(scope="module")
def description(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return create_app(ServiceSettings(data=tmp_path_factory.mktemp("data"))).openapi()


def operations(description: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [(path, method, call) for path, calls in description["paths"].items() for method, call in calls.items()]


def test_operations_have_plain_names_of_their_own_and_say_what_they_do(description: dict[str, Any]) -> None:
    names = [call["operationId"] for _, _, call in operations(description)]
    assert len(names) == len(set(names)) > 45
    for path, method, call in operations(description):
        assert re.fullmatch(r"[a-z]+(_[a-z]+)*", call["operationId"]), (method, path)
        assert call.get("description"), (method, path)
        assert call.get("tags"), (method, path)


def test_every_answer_has_a_type(description: dict[str, Any]) -> None:
    for path, method, call in operations(description):
        for status, answer in call["responses"].items():
            where = (method, path, status)
            if status[0] in "45":
                typed = answer.get("content", {}).get("application/problem+json", {}).get("schema", {})
                known = typed.get("$ref", "").endswith("/Problem") or (path, status) == ("/readyz", "503")
                assert known or status == "460", where
            elif status not in NO_BODY and call["operationId"] not in {*TUS_BODILESS, "tus_delete", "tus_options"}:
                assert answer.get("content"), where
                for media, content in answer["content"].items():
                    assert content or media == "application/json", (*where, media)


def test_the_description_names_the_server_and_what_changes_conditionally(description: dict[str, Any]) -> None:
    assert description["servers"] == [{"url": "/"}]
    calls = description["paths"]["/v1/captures/{capture_id}"]
    assert "ETag" in calls["get"]["responses"]["200"]["headers"]
    for method in ("patch", "delete"):
        assert "If-Match" in [parameter["name"] for parameter in calls[method]["parameters"]]
        assert "412" in calls[method]["responses"]


def test_files_are_bytes_moments_date_times_and_each_name_one_type(description: dict[str, Any]) -> None:
    results = description["paths"]["/v1/jobs/{job_id}/result/{name}"]["get"]["responses"]
    for status in ("200", "206"):
        for media in ("application/octet-stream", "model/gltf-binary", "image/png"):
            assert results[status]["content"][media]["schema"] == {"type": "string", "format": "binary"}
    for name in ("CaptureOut", "SessionOut", "JobOut", "CalibrationOut"):
        for field in ("created", "started", "finished"):
            schema = description["components"]["schemas"][name]["properties"].get(field)
            assert schema is None or "'format': 'date-time'" in str(schema), (name, field)
    # FastAPI tells equal names apart by their modules, and client generators then drop one.
    assert [name for name in description["components"]["schemas"] if "__" in name] == []


def test_bodies_have_examples_that_fit(description: dict[str, Any]) -> None:
    schemas = description["components"]["schemas"]
    seen = 0
    for path, method, call in operations(description):
        schema = call.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema")
        for option in [] if schema is None else schema.get("anyOf", [schema]):
            reference = option.get("$ref")
            body = schemas[reference.rpartition("/")[2]] if reference else option
            if body.get("type") == "null":
                continue
            assert body.get("examples"), (method, path)
            judge = jsonschema_rs.validator_for(body | {"components": description["components"]})
            for example in body["examples"]:
                judge.validate(example)
                seen += 1
    assert seen >= 12


def test_a_jobs_settings_are_those_of_the_pipeline(description: dict[str, Any]) -> None:
    schema = {"$ref": "#/components/schemas/Settings", "components": description["components"]}
    judge = jsonschema_rs.validator_for(schema)
    assert judge.is_valid({"detail": "fine", "outputs": {"surface": "both"}, "fail_on": ["camera-moved"]})
    for wrong in ({"detial": "fine"}, {"detail": "finest"}, {"fail_on": ["moved"]}, {"bust": {"spacing_mm": 9}}):
        assert not judge.is_valid(wrong), wrong


def test_the_page_of_the_api_asks_for_nothing_from_elsewhere() -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert re.findall(r"https?://|(?:src|href)=\"(?!openapi\.json)", text) == []
