"""Shares are one whole, and the same on every machine."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import InputError
from server.batch.shards import WHOLE, Shard, read_shard


@given(st.text(), st.integers(1, 50))
def test_each_name_is_of_exactly_one_share(name: str, count: int) -> None:
    assert sum(Shard(number, count).takes(name) for number in range(1, count + 1)) == 1
    assert WHOLE.takes(name)


def test_the_hash_stays_what_it_is() -> None:
    """A batch that is half done goes on with a later version: the shares must not move."""
    assert [[k for k in range(20) if Shard(number, 3).takes(f"s{k:02}")] for number in (1, 2, 3)] == [
        [3, 7, 12, 14, 15],
        [0, 4, 6, 9, 16, 19],
        [1, 2, 5, 8, 10, 11, 13, 17, 18],
    ]


def test_shares_are_about_equal() -> None:
    counts = [sum(Shard(number, 8).takes(f"capture-{k}") for k in range(4000)) for number in range(1, 9)]
    # Binomial(4000, 1/8): 500 with a standard deviation of 21
    assert max(abs(count - 500) for count in counts) < 4 * 21


@pytest.mark.parametrize(("text", "shard"), [("1/1", WHOLE), ("3/8", Shard(3, 8)), (" 8/8 ", Shard(8, 8))])
def test_a_share_is_read(text: str, shard: Shard) -> None:
    assert read_shard(text) == shard
    assert read_shard(str(shard)) == shard


@pytest.mark.parametrize("text", ["", "0/8", "9/8", "1/0", "a/b", "1", "1/8/2", "-1/8", "1.5/2", "٣/8", "1/1000000"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="is no share such as 2/8"):
        read_shard(text)
