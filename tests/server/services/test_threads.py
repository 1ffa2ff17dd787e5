"""Checks of uploads: shares of the keys, and what becomes of too many."""

import asyncio
import threading
from functools import partial

import pytest

from server.errors import TooMany
from server.services.threads import IN_LINE_MOST, Threads


def test_one_key_leaves_a_place_for_others() -> None:
    async def run() -> list[str]:
        threads, release, ended = Threads(checks=2), threading.Event(), list[str]()

        def work(name: str) -> None:
            release.wait(60)
            ended.append(name)

        busy = [asyncio.create_task(threads.check(work, "busy", key="a")) for _ in range(3)]
        await asyncio.sleep(0.05)
        await threads.check(ended.append, "other", key="b")
        release.set()
        await asyncio.gather(*busy)
        return ended

    assert asyncio.run(run()) == ["other", "busy", "busy", "busy"]


def test_more_than_a_line_of_one_key_is_refused() -> None:
    async def run() -> None:
        threads, release = Threads(checks=2), threading.Event()
        line = [asyncio.create_task(threads.check(partial(release.wait, 60), key="a")) for _ in range(IN_LINE_MOST)]
        await asyncio.sleep(0.05)
        try:
            with pytest.raises(TooMany) as refused:
                await threads.check(release.wait, 60, key="a")
            assert refused.value.retry_after_s
        finally:
            release.set()
            await asyncio.gather(*line)
        assert await threads.check(lambda: 5, key="a") == 5

    asyncio.run(run())
