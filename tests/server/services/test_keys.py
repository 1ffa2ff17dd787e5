"""API keys in the database: whose a token is, what it may do, and where the service may listen without one."""

import hashlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from server.errors import NotFound
from server.services.keys import ApiKey, Caller, KeylessAddress, Keys, check_address
from server.settings import ServiceSettings
from server.storage.database import api_keys, open_database


@pytest.fixture
def keys(tmp_path: Path) -> Iterator[Keys]:
    engine = open_database(ServiceSettings(data=tmp_path))
    yield Keys(engine)
    engine.dispose()


def test_a_key_is_its_holders_with_its_scopes(keys: Keys) -> None:
    assert not keys.any()
    token = keys.add("lab", ("read", "submit"))
    identity = token.split("_")[1]
    assert re.fullmatch(r"eh_[0-9a-f]{12}_[\w-]{43}", token)
    assert keys.any()
    assert keys.caller(token) == Caller(identity, frozenset({"read", "submit"}))


def test_keys_are_listed_oldest_first_and_removed_alone(keys: Keys) -> None:
    tokens = [keys.add(name, (scope,)) for name, scope in (("a", "read"), ("b", "admin"), ("c", "capture"))]
    listed = keys.all()
    assert [(key.id, key.name, key.scopes) for key in listed] == [
        (token.split("_")[1], name, (scope,))
        for token, (name, scope) in zip(tokens, (("a", "read"), ("b", "admin"), ("c", "capture")), strict=True)
    ]
    assert all(isinstance(key, ApiKey) and 1.7e9 < key.created < 1e10 for key in listed)
    keys.remove(listed[1].id)
    assert [key.name for key in keys.all()] == ["a", "c"]
    assert keys.caller(tokens[1]) is None
    assert keys.caller(tokens[2]) is not None
    with pytest.raises(NotFound, match=listed[1].id):
        keys.remove(listed[1].id)


@pytest.mark.parametrize(
    "change",
    [
        lambda token: token[:-1] + ("A" if token[-1] != "A" else "B"),
        lambda token: token + "A",
        lambda token: "xh" + token[2:],
        lambda token: token.replace("eh_", "eh_0", 1),
        lambda token: token.rpartition("_")[0],
        lambda token: "eh__",
        lambda token: "eh",
        lambda token: "",
        lambda token: token.split("_", 2)[2],
    ],
)
def test_a_token_that_is_not_quite_one_is_nobodys(keys: Keys, change: Callable[[str], str]) -> None:
    assert keys.caller(change(keys.add("lab", ("admin",)))) is None


def test_secrets_may_hold_underscores_and_open_no_other_key(keys: Keys) -> None:
    tokens = [keys.add(f"{i}", ("read",)) for i in range(40)]  # url-safe characters: most have one
    assert any(token.count("_") > 2 for token in tokens)
    assert all(keys.caller(token) is not None for token in tokens)
    one, two = keys.add("one", ("read",)), keys.add("two", ("admin",))
    mixed = "_".join([*two.split("_", 2)[:2], one.split("_", 2)[2]])
    assert keys.caller(mixed) is None


def test_only_a_hash_is_stored(keys: Keys, tmp_path: Path) -> None:
    secret = keys.add("lab", ("read",)).split("_", 2)[2]
    engine = open_database(ServiceSettings(data=tmp_path))
    with engine.connect() as connection:
        rows = connection.execute(sa.select(api_keys)).fetchall()
    engine.dispose()
    assert hashlib.sha256(secret.encode()).hexdigest() in rows[0]
    assert secret not in str(rows)


def test_the_network_needs_a_key_and_the_refusal_names_the_place(keys: Keys, tmp_path: Path) -> None:
    check_address(ServiceSettings(data=tmp_path), keys)
    with pytest.raises(KeylessAddress, match=r"^refusing to listen on 0\.0\.0\.0 without an API key"):
        check_address(ServiceSettings(data=tmp_path, host="0.0.0.0"), keys)
    public = ServiceSettings(data=tmp_path, public_url="https://heads.example")
    remedy = re.escape(f"`eigenhead keys add NAME --data {tmp_path}`")  # the data folder's that was asked to serve
    with pytest.raises(KeylessAddress, match=rf"listen on https://heads\.example without .*{remedy}"):
        check_address(public, keys)
    keys.add("lab", ("read",))
    check_address(public, keys)
    check_address(ServiceSettings(data=tmp_path, host="0.0.0.0"), keys)
