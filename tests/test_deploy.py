"""The files of deploy/: what systemd, containers and proxies are told fits the code and each other."""

import configparser
import importlib.util
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from server.metrics import Metrics, QueueFigures, StoreFigures
from server.problem_types import PROBLEM_TYPES
from server.settings import PREFIX, ServiceSettings

ROOT = Path(__file__).resolve().parents[1]
DEPLOY = ROOT / "deploy"


def unit() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(DEPLOY / "eigenhead.service")
    return parser


def compose() -> dict[str, Any]:
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())


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
    spec = importlib.util.spec_from_file_location("fetch_uv", DEPLOY / "fetch_uv.py")
    assert spec is not None
    assert spec.loader is not None
    fetch_uv = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fetch_uv)
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
    if shutil.which("caddy") is None:
        pytest.skip("Caddy is not installed (apt-get install caddy)")
    command = ["caddy", "adapt", "--config", str(DEPLOY / "Caddyfile"), "--adapter", "caddyfile"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert '"127.0.0.1:8600"' in done.stdout
    assert '"heads.example"' in done.stdout


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
    figures = {"cpu": QueueFigures(3, 10.0, 1)}
    store = StoreFigures(False, {("put", "unavailable"): 3}, {"put": 1.0})
    others: dict[str, Any] = {"failures": {"no-subject": 2}, "store": store}
    shown = Metrics().exposition({"queued": 3}, captures=1, free=1, damaged=0, queues=figures, **others).decode()
    known = set(re.findall(r"^# TYPE (\w+)", shown, re.M))
    assert {name for rule in rules for name in re.findall(r"eigenhead_\w+", rule["expr"])} <= known
    kinds = "|".join(found for rule in rules for found in re.findall(r'kind=~"([^"]+)"', rule["expr"]))
    assert set(kinds.split("|")) <= set(PROBLEM_TYPES)
    assert all({"summary", "remedy"} == rule["annotations"].keys() for rule in rules)


def test_promtool_accepts_the_alerts() -> None:
    if (promtool := shutil.which("promtool")) is None:
        pytest.skip("promtool is not installed (apt-get install prometheus)")
    command = [promtool, "check", "rules", str(DEPLOY / "prometheus-rules.yml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
