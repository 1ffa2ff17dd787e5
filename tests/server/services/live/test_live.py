"""The live head of a service before real streams: it begins when somebody asks, outlives its child, and ends."""

import json
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from server.services.live.live import IDLE_S, NICENESS
from tests.server.services.live.conftest import DrawnRig
from tests.support.services import RunningService, await_true, awaited, pids_of, served_client

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]


def until(client: httpx.Client, fits: Callable[[dict], bool], timeout_s: float = 120.0) -> dict:
    return awaited(lambda: client.get("/v1/rig/live").raise_for_status().json(), fits, timeout_s)


def said(answer: dict) -> set[str]:
    return {word["code"] for word in answer["words"]}


def children(service: RunningService) -> list[int]:
    """The live head's child processes, told by their niceness."""
    ours = [b"server.tasks.child"], str(NICENESS).encode()
    return pids_of(service, lambda words: (words[-4:-3], words[-2]) == ours)


def kill_while_it_is_asked(service: RunningService, client: httpx.Client) -> int:
    """Kills the child so that this is said; one that dies between two looks is begun again without a word, as a busy
    machine may have it. Returns the id of the one that was killed."""
    for stopped_s in (1.5, 6.0, 24.0):
        until(client, lambda answer: answer["head"] is not None)
        (child,) = children(service)
        os.kill(child, signal.SIGSTOP)
        time.sleep(stopped_s)
        os.kill(child, signal.SIGKILL)
        with suppress(AssertionError):
            until(client, lambda answer: "live-again" in said(answer), 10.0 + stopped_s)
            return child
    raise AssertionError("nobody was told that the head is followed anew")


def test_a_head_is_followed_while_somebody_asks(rig: DrawnRig, tmp_path: Path) -> None:
    with served_client(tmp_path / "data", worker=False, rig=str(rig.toml)) as (service, client):
        first = client.get("/v1/rig/live").json()
        assert (said(first), first["head"], first["cameras"]) == ({"live-starting"}, None, {})
        assert said(until(client, lambda answer: bool(answer["cameras"]) and bool(answer["words"]))) == {"live-nobody"}

        rig.devices.seat(True)
        seated = until(client, lambda answer: answer["head"] is not None and answer["steady"])
        assert abs(seated["head"]["left_deg"]) < 10.0
        faces = [seated["cameras"][name]["face"] for name in ("cam0", "cam1", "cam2", "cam5")]
        assert faces == [True, True, True, None]
        assert not seated["cameras"]["cam5"]["looking"]
        assert len(seated["head"]["vertices"]) > 100
        assert max(max(corners) for corners in seated["head"]["triangles"]) < len(seated["head"]["vertices"])

        rig.turn(30.0)
        turned = until(client, lambda answer: "live-turn-right" in said(answer))
        (word,) = (word for word in turned["words"] if word["code"] == "live-turn-right")
        assert word["message"]["parameters"]["angle_deg"] == pytest.approx(30.0, abs=8.0)
        assert word["text"] == word["message"]["message"]
        rig.turn(0.0)
        until(client, lambda answer: "live-turn-right" not in said(answer))

        child = kill_while_it_is_asked(service, client)
        until(client, lambda answer: answer["head"] is not None)
        assert children(service) not in ([], [child])

        with client.stream("GET", "/v1/rig/live?seconds=2", headers={"Accept": "text/event-stream"}) as stream:
            events = [line for line in stream.iter_lines() if line.startswith("data: ")]
        assert json.loads(events[-1].removeprefix("data: "))["head"] is not None

        await_true(lambda: children(service) == [], IDLE_S + 60.0)


def test_an_answer_never_waits_for_the_cameras(rig: DrawnRig, tmp_path: Path) -> None:
    """A camera that hangs, and the model that is being read, do not hold up who asks."""
    with served_client(tmp_path / "data", worker=False, rig=str(rig.toml)) as (_, client):
        for _ in range(30):
            begun = time.monotonic()
            client.get("/v1/rig/live").raise_for_status()
            answered = time.monotonic()
            client.get("/healthz").raise_for_status()
            assert answered - begun < 2.0 + 10.0 * (time.monotonic() - answered)
            time.sleep(0.1)
