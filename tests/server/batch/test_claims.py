"""One holder a claim, whoever dies and whenever."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from server.batch.claims import Claims
from server.processes import process_identity


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "claims"


@contextmanager
def open_claims(folder: Path, count: int, **options: float) -> Iterator[list[Claims]]:
    with ExitStack() as stack:
        claims = [Claims(folder, **options) for _ in range(count)]
        for each in claims:
            stack.enter_context(each.beating())
        yield claims


def dead_owner(folder: Path, name: str, token: str = "dead") -> None:
    """What a process leaves that was killed: it had the number of one that is gone."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    owner = {"machine": process_identity()[0], "host": "here", "pid": gone.pid, "started": 1}
    (folder / "owners").mkdir(parents=True, exist_ok=True)
    (folder / "owners" / f"{token}.json").write_text(json.dumps(owner))
    (folder / name).symlink_to(f"owners/{token}.json")


def test_a_claim_has_one_holder_until_it_is_given_back(folder: Path) -> None:
    with open_claims(folder, 2) as (one, other):
        assert one.take("anna")
        assert one.holds("anna")
        assert not other.take("anna")
        assert not one.take("anna")
        other.release("anna")  # not its own
        assert one.holds("anna")
        one.release("anna")
        assert other.take("anna")
        assert other.take("bert")
        other.release("anna")
        other.release("bert")
    assert list(folder.iterdir()) == [folder / "owners"]
    assert list((folder / "owners").iterdir()) == []


@pytest.mark.parametrize("left", ["gone", "no file", "damaged"])
def test_a_claim_of_the_dead_is_free(folder: Path, left: str) -> None:
    dead_owner(folder, "anna")
    if left == "no file":
        (folder / "owners" / "dead.json").unlink()
    if left == "damaged":
        (folder / "owners" / "dead.json").write_text("{")
    with open_claims(folder, 1) as (claims,):
        assert claims.take("anna")
        assert claims.holds("anna")
        assert sorted(path.name for path in folder.iterdir()) == ["anna", "owners"]


def test_who_is_silent_on_another_machine_has_lost_its_claims_and_who_beats_has_not(folder: Path) -> None:
    dead_owner(folder, "anna", "elsewhere")
    file = folder / "owners" / "elsewhere.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"machine": "another"}))
    with open_claims(folder, 1, silent_s=60.0) as (claims,):
        assert not claims.take("anna")
        now = time.time()
        os.utime(file, (now - 50, now - 50))
        assert not claims.take("anna")
        os.utime(file, (now - 70, now - 70))
        assert claims.take("anna")


def test_of_many_who_take_a_dead_claim_at_once_one_has_it(folder: Path) -> None:
    """Fifty times twelve at once; the dead one's breaker is dead, too."""
    with open_claims(folder, 12) as many:
        for turn in range(50):
            dead_owner_of_both(folder, f"name{turn}")
            start, taken = threading.Barrier(len(many)), list[Claims]()

            def race(claims: Claims, name: str, start: threading.Barrier, taken: list[Claims]) -> None:
                start.wait()
                if claims.take(name):
                    taken.append(claims)

            threads = [threading.Thread(target=race, args=(each, f"name{turn}", start, taken)) for each in many]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert len(taken) == 1
            assert taken[0].holds(f"name{turn}")
        assert not list(folder.glob("*~*"))


def dead_owner_of_both(folder: Path, name: str) -> None:
    (folder / name).symlink_to("owners/first.json")
    (folder / f"{name}~first").symlink_to("owners/second.json")


def test_what_the_dead_left_is_forgotten_and_the_living_keep_theirs(folder: Path) -> None:
    dead_owner(folder, "anna")
    dead_owner_of_both(folder, "carl")
    with open_claims(folder, 2) as (one, other):
        assert other.take("bert")
        one.forget_dead()
        assert sorted(path.name for path in folder.iterdir()) == ["bert", "owners"]
        assert {path.stem for path in (folder / "owners").iterdir()} == {one.token, other.token}
        assert other.holds("bert")


def test_a_process_that_was_taken_for_dead_shows_itself_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.batch.claims.BEAT_S", 0.02)
    with open_claims(folder, 1) as (claims,):
        file = folder / "owners" / f"{claims.token}.json"
        file.unlink()
        deadline = time.monotonic() + 10
        while not file.exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
