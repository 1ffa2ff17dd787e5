"""Divides a batch among machines that do not communicate, by a stable hash of the captures' names."""

import hashlib
import re
from dataclasses import dataclass

from rig.errors import InputError
from rig.messages.message import compose

SHARDS_MOST = 100_000


@dataclass(frozen=True, slots=True)
class Shard:
    """Holds one share of a batch, to be made by one machine: ``number`` (from 1) of ``count`` shares."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def takes(self, name: str) -> bool:
        """Returns whether the capture with this name belongs to this share. Each capture belongs to exactly one."""
        digest = hashlib.sha256(name.encode()).digest()
        return int.from_bytes(digest[:8], "big") % self.count == self.number - 1


WHOLE = Shard(1, 1)


def read_shard(text: str) -> Shard:
    """Reads a share from the text K/N, where K is from 1 to N. Raises InputError."""
    parts = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text.strip())
    number, count = (int(parts[1]), int(parts[2])) if parts else (0, 0)
    if not 1 <= number <= count <= SHARDS_MOST:
        raise InputError("shard", [compose("batch-shard-wrong", text=f"{text!r:.40}", most=SHARDS_MOST)])
    return Shard(number, count)
