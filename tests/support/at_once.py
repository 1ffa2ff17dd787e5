"""Runs one piece of work in several threads at once."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def run_at_once(work: Callable[[], Any], count: int = 2) -> list[Any]:
    """Returns what each thread returned. Raises what any of them raised."""
    with ThreadPoolExecutor(count) as pool:
        return [each.result() for each in [pool.submit(work) for _ in range(count)]]
