"""File systems of their own, for what happens where a disk is full or cannot be written."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def small_disk(folder: Path, megabytes: int, *options: str) -> Iterator[Path]:
    """A file system of its own that can be filled; ``options`` of mount: "ro" for one that is only read."""
    folder.mkdir()
    mount_options = ",".join((f"size={megabytes}m", *options))
    command = ["mount", "-t", "tmpfs", "-o", mount_options, "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a tmpfs needs root")
    try:
        yield folder
    finally:
        for _ in range(50):
            if subprocess.run(["umount", str(folder)], capture_output=True, check=False).returncode == 0:
                break
            time.sleep(0.1)
