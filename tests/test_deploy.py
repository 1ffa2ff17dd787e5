"""The files of deploy/: what systemd, containers and proxies are told fits the code and each other."""

import configparser
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
import yaml
from prometheus_client import generate_latest

from server.metrics import Metrics
from server.problem_types import PROBLEM_TYPES
from server.services.job_rows import WORKFLOW
from server.settings import PREFIX, ServiceSettings
from server.storage.job_index import ENQUEUED, RUNNING, engine_jobs
from tests.support.scripts import import_script

ROOT = Path(__file__).resolve().parents[1]
DEPLOY = ROOT / "deploy"


def unit() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(DEPLOY / "eigenhead.service")
    return parser


def compose() -> dict[str, Any]:
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())


def accepted(program: str, *arguments: str | Path) -> str:
    """What a program says that must be content, or a visible skip."""
    if (found := shutil.which(program)) is None:
        pytest.skip(f"{program} is not installed")
    command = [found, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_the_unit_reaches_every_device_that_the_rules_open() -> None:
    groups = set(re.findall(r'GROUP="(\w+)"', (DEPLOY / "99-eigenhead.rules").read_text()))
    assert groups == {"dialout", "video", "plugdev"}
    assert set(unit()["Service"]["SupplementaryGroups"].split()) == groups


def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed (apt-get install systemd)")
    text = (DEPLOY / "eigenhead.service").read_text()
    (tmp_path / "eigenhead.service").write_text(re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", text, flags=re.M))
    command = ["systemd-analyze", "verify", "--man=no", str(tmp_path / "eigenhead.service")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    complaints = [line for line in done.stderr.splitlines() if "eigenhead.service" in line]
    assert complaints == []


def test_the_unit_is_as_closed_as_cameras_and_compiled_loops_let_it_be() -> None:
    """2 of 10 and more is what systemd calls MEDIUM; what is left are devices, the network and W^X."""
    accepted("systemd-analyze", "security", "--offline=true", "--threshold=26", DEPLOY / "eigenhead.service")
    assert {"MemoryMax", "SystemCallFilter", "CapabilityBoundingSet"} <= unit()["Service"].keys()


def test_containers_and_pods_may_write_where_they_must_and_no_more() -> None:
    services = compose()["services"]
    assert all("mem_limit" in service and service["security_opt"] for service in services.values())
    for name in ("service", "worker", "gpu-worker", "proxy"):
        assert services[name]["read_only"], name
        assert services[name]["cap_drop"] == ["ALL"], name
    assert all("--check" in services[name]["healthcheck"]["test"] for name in ("worker", "gpu-worker"))
    documents = manifests()
    assert sum(document["kind"] == "NetworkPolicy" for document in documents) == 2
    for pod in [d["spec"]["template"]["spec"] for d in documents if d["kind"] in ("Deployment", "Job")]:
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        closed = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
        assert pod["containers"][0]["securityContext"] == closed


def test_no_container_publishes_a_port_without_tls() -> None:
    published = {name: service.get("ports", []) for name, service in compose()["services"].items()}
    assert published.pop("proxy") == ["80:80", "443:443"]
    assert all(port.startswith("127.0.0.1:") for ports in published.values() for port in ports)
    assert compose()["services"]["proxy"]["environment"]["EIGENHEAD_UPSTREAM"] == "service:8600"


def test_the_gpu_worker_may_draw() -> None:
    environment = compose()["services"]["gpu-worker"]["environment"]
    assert "graphics" in environment["NVIDIA_DRIVER_CAPABILITIES"].split(",")
    assert "EIGENHEAD_DATABASE_URL" in environment


def test_every_variable_of_the_containers_is_a_setting() -> None:
    known = {PREFIX + name.upper() for name in ServiceSettings.model_fields} | {"EIGENHEAD_CACHE"}
    read_by_caddy = set(re.findall(r"\{\$(\w+)", (DEPLOY / "Caddyfile").read_text()))
    for service in compose()["services"].values():
        assert {name for name in service.get("environment", {}) if name.startswith(PREFIX)} <= known | read_by_caddy
    assert set(re.findall(PREFIX + r"[A-Z_]+(?==)", (DEPLOY / "Dockerfile").read_text())) <= known
    assert set(re.findall(PREFIX + r"[A-Z_]+(?==)", unit()["Service"]["Environment"])) <= known


def test_the_image_fetches_before_it_copies_sources_and_pins_uv() -> None:
    fetch_uv = import_script(DEPLOY / "fetch_uv.py")
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    assert any(line.endswith(f"uv=={fetch_uv.VERSION}") for line in lines)
    synced = next(number for number, line in enumerate(lines) if "--no-install-project" in line)
    assert {"COPY rig rig", "COPY server server"} <= set(lines[synced:])
    copied = {word for line in lines if line.startswith("COPY") for word in line.split()[1:-1]}
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert "*" in ignored
    assert {line.removeprefix("!") for line in ignored if line.startswith("!")} == copied
    assert all((ROOT / name).exists() for name in copied)


def test_caddy_accepts_its_file() -> None:
    adapted = accepted("caddy", "adapt", "--config", DEPLOY / "Caddyfile", "--adapter", "caddyfile")
    assert '"127.0.0.1:8600"' in adapted
    assert '"heads.example"' in adapted


@pytest.mark.parametrize(
    ("step", "status", "text"), [("demo", 0, "try_debian: skipped: "), ("sleep", 2, "unknown step sleep")]
)
def test_a_debian_is_tried_only_where_one_can_be_made(step: str, status: int, text: str) -> None:
    """debootstrap lies in /usr/sbin, which this path leaves out; without root it is not even looked for."""
    command = ["bash", str(DEPLOY / "try_debian.sh"), step]
    environment = {"PATH": "/usr/bin:/bin", "HOME": "/nonexistent"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == status
    assert text in done.stderr


@pytest.mark.parametrize(
    ("variables", "share"),
    [
        ({}, "1/1"),
        ({"ID": "3", "MIN": "1", "COUNT": "8", "STEP": "1"}, "3/8"),
        ({"ID": "0", "MIN": "0", "COUNT": "8", "STEP": "1"}, "1/8"),
        ({"ID": "9", "MIN": "1", "COUNT": "8", "STEP": "2"}, "5/8"),
    ],
)
def test_an_array_of_slurm_is_one_share_a_job(tmp_path: Path, variables: dict[str, str], share: str) -> None:
    (tmp_path / "eigenhead").write_text('#!/bin/sh\nprintf "%s|" "$@"\n')
    (tmp_path / "eigenhead").chmod(0o755)
    array = {f"SLURM_ARRAY_TASK_{name}": value for name, value in variables.items()}
    done = subprocess.run(
        [DEPLOY / "batch.slurm", "a study.csv", "heads", "--detail", "photo"],
        env=os.environ | array | {"EIGENHEAD": str(tmp_path / "eigenhead")},
        capture_output=True, text=True, timeout=20, check=True,
    )  # fmt: skip
    assert done.stdout == f"batch|a study.csv|--out|heads|--shard|{share}|--detail|photo|"


def test_the_job_of_slurm_says_what_it_needs() -> None:
    done = subprocess.run([DEPLOY / "batch.slurm"], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode != 0
    assert "name a folder of captures or a list: sbatch" in done.stderr


def test_the_alerts_ask_for_metrics_that_there_are() -> None:
    """By the names alone; promtool, where it is installed, reads the expressions."""
    text = (DEPLOY / "prometheus-rules.yml").read_text()
    rules = [rule for group in yaml.safe_load(text)["groups"] for rule in group["rules"]]
    shown = generate_latest(Metrics().registry).decode()
    known = set(re.findall(r"^# TYPE (\w+)", shown, re.M))
    assert {name for rule in rules for name in re.findall(r"eigenhead_\w+", rule["expr"])} <= known
    kinds = "|".join(found for rule in rules for found in re.findall(r'kind=~"([^"]+)"', rule["expr"]))
    assert set(kinds.split("|")) <= set(PROBLEM_TYPES)
    assert all({"summary", "remedy"} == rule["annotations"].keys() for rule in rules)


def test_promtool_accepts_the_alerts() -> None:
    accepted("promtool", "check", "rules", DEPLOY / "prometheus-rules.yml")


def test_the_store_of_the_containers_has_one_key_and_one_address() -> None:
    services = yaml.safe_load((DEPLOY / "compose.store.yaml").read_text())["services"]
    store, users = services.pop("store"), [service["environment"] for service in services.values()]
    known = {PREFIX + name.upper() for name in ServiceSettings.model_fields}
    assert services.keys() == {"service", "worker", "gpu-worker"} <= compose()["services"].keys()
    assert all(user == users[0] for user in users)
    assert {name for name in users[0] if name.startswith(PREFIX)} <= known
    assert store["environment"].items() <= users[0].items()
    assert users[0]["EIGENHEAD_STORE_ENDPOINT"] == "http://store:8333"
    assert {f"{PREFIX}{what}_{of}" for what in ("CAPTURES", "RESULTS") for of in ("STORE", "BYTES")} <= users[0].keys()
    assert "-s3.port=8333" in store["command"]
    assert "ports" not in store, "it has no TLS"


def composed(*files: str) -> dict[str, Any]:
    """What Compose makes of the files together, or a visible skip."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]) and subprocess.run([*command, "version"], capture_output=True).returncode == 0:
            break
    else:
        pytest.skip("Compose is not installed (apt-get install docker-compose)")
    named = [word for file in files for word in ("-f", str(DEPLOY / file))]
    secrets = {"POSTGRES_PASSWORD": "of the test", "STORE_SECRET": "of the test"}
    call = [*command, "-p", "heads", *named, "config"]
    done = subprocess.run(call, env=os.environ | secrets, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return yaml.safe_load(done.stdout)


def test_compose_accepts_the_containers_with_and_without_a_store() -> None:
    assert "EIGENHEAD_CAPTURES_STORE" not in composed("compose.yaml")["services"]["worker"]["environment"]
    services = composed("compose.yaml", "compose.store.yaml")["services"]
    for name in ("service", "worker"):
        environment = services[name]["environment"]
        assert environment["EIGENHEAD_CAPTURES_STORE"] == "s3://heads/captures/"
        assert int(environment["EIGENHEAD_CAPTURES_BYTES"]) == ServiceSettings().captures_bytes
        assert "EIGENHEAD_DATABASE_URL" in environment, "which the other file says"


def manifests() -> list[dict[str, Any]]:
    files = sorted((DEPLOY / "kubernetes").glob("*/*.yaml"))
    return [document for file in files for document in yaml.safe_load_all(file.read_text())]


def test_the_manifests_name_settings_and_each_other() -> None:
    documents = manifests()
    named = {(document["kind"], document["metadata"]["name"]) for document in documents if "metadata" in document}
    pods = [d["spec"]["template"]["spec"] for d in documents if d["kind"] in ("Deployment", "Job")]
    assert len(pods) == 3
    for pod in pods:
        (container,) = pod["containers"]
        assert ("PersistentVolumeClaim", pod["volumes"][0]["persistentVolumeClaim"]["claimName"]) in named
        assert [mount["name"] for mount in container["volumeMounts"]] == [volume["name"] for volume in pod["volumes"]]
        assert f"--uid {pod['securityContext']['runAsUser']} " in (DEPLOY / "Dockerfile").read_text()
    (scaled,) = (document["spec"] for document in documents if document["kind"] == "ScaledObject")
    assert ("Deployment", scaled["scaleTargetRef"]["name"]) in named
    assert ("TriggerAuthentication", scaled["triggers"][0]["authenticationRef"]["name"]) in named
    generated = [g for d in documents for g in d.get("configMapGenerator", ())]
    variables = {literal.partition("=")[0] for g in generated for literal in g["literals"]}
    assert variables <= {PREFIX + name.upper() for name in ServiceSettings.model_fields}


def test_the_volume_holds_what_the_bounds_let_it_hold() -> None:
    (base,) = yaml.safe_load_all((DEPLOY / "kubernetes" / "base" / "kustomization.yaml").read_text())
    literals = dict(literal.split("=", 1) for literal in base["configMapGenerator"][0]["literals"])
    stores = [literals[f"EIGENHEAD_{what}_STORE"] for what in ("CAPTURES", "RESULTS")]
    assert len({*stores}) == 2, "a place each"
    bounds = [int(literals[f"EIGENHEAD_{what}_BYTES"]) for what in ("CAPTURES", "RESULTS")]
    (claim,) = (document for document in manifests() if document["kind"] == "PersistentVolumeClaim")
    size = claim["spec"]["resources"]["requests"]["storage"]
    assert sum(bounds) < 0.7 * int(size.removesuffix("Gi")) * (1 << 30)


def test_workers_are_scaled_by_what_the_engine_calls_a_job() -> None:
    (scaled,) = (document["spec"] for document in manifests() if document["kind"] == "ScaledObject")
    query = scaled["triggers"][0]["metadata"]["query"]
    assert set(re.findall(r"'(\w+)'", query)) == {WORKFLOW, ServiceSettings().queue, *ENQUEUED, RUNNING} - {"DELAYED"}
    columns = engine_jobs(sa.create_engine("sqlite://")).c.keys()
    assert set(re.findall(r"\b(name|queue_name|status)\b(?= [=I])", query)) <= set(columns)


def test_kubernetes_accepts_the_manifests(tmp_path: Path) -> None:
    (tmp_path / "all.yaml").write_text(accepted("kubectl", "kustomize", DEPLOY / "kubernetes" / "example"))
    said = accepted("kubernetes-validate", "--strict", tmp_path / "all.yaml")
    unknown = re.findall(r"find schema for kind (\w+)", said)
    assert set(unknown) <= {"ScaledObject", "TriggerAuthentication"}, "which are KEDA's"


def test_the_dashboard_asks_for_metrics_that_there_are() -> None:
    dashboard = json.loads((DEPLOY / "grafana-dashboard.json").read_text())
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    known = {name for family in Metrics().registry.collect() for name in (family.name, f"{family.name}_bucket")}
    assert {name for text in expressions for name in re.findall(r"eigenhead_\w+", text)} <= known
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])
    places = [tuple(panel["gridPos"].values()) for panel in dashboard["panels"]]
    assert len({(x, y) for x, y, *_ in places}) == len(places)
    assert all(text.count("(") == text.count(")") for text in expressions)
    alerts = yaml.safe_load((DEPLOY / "prometheus-rules.yml").read_text())["groups"][0]["rules"]
    shown = " ".join(expressions)
    assert all(name in shown for rule in alerts for name in re.findall(r"eigenhead_\w+", rule["expr"]))


def test_promtool_accepts_the_dashboard(tmp_path: Path) -> None:
    """Its expressions, as if they were rules."""
    panels = json.loads((DEPLOY / "grafana-dashboard.json").read_text())["panels"]
    expressions = [target["expr"] for panel in panels for target in panel["targets"]]
    rules = [{"record": f"panel:{number}", "expr": text} for number, text in enumerate(expressions)]
    (tmp_path / "rules.yml").write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": rules}]}))
    accepted("promtool", "check", "rules", tmp_path / "rules.yml")
