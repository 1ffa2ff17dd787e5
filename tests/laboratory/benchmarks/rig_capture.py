"""How long does a capture take, and does the pipeline reconstruct it?

python -m tests.laboratory rig_capture --captures 5 --reconstruct

``eigenhead simulate --serve`` runs as a process (eleven streams of 1024 x 768 and a trigger box on a pty), ``eigenhead
rig capture`` takes one capture after the other, each a process of its own; ``seconds`` are from the warm rig to the
complete folder, as the command states them. The last capture is reconstructed by ``eigenhead reconstruct`` and compared
with the truth.
"""

from pathlib import Path
from statistics import median
from typing import Any

from server.services.truth import error_mm
from tests.support.served_studio import command, served_studio


def run(scratch: Path, *, captures: int = 5, seed: int = 3, reconstruct: bool = False) -> dict[str, Any]:
    """Returns the figures of this module."""
    seconds, warm_up_s, spreads_ms, skews = [], [], [], 0
    with served_studio(scratch / "studio", "--seed", str(seed)) as studio:
        for index in range(captures):
            taken = command("rig", "capture", "--rig", studio["rig"], "--out", str(scratch / f"capture{index}"))
            seconds.append(taken["seconds"]["capture"])
            warm_up_s.append(taken["seconds"]["warm_up"])
            spreads_ms.append(taken["sync"]["spread_ms"])
            skews += sum(line["skew_ms"] is not None for line in taken["sync"]["cameras"].values())
        truth = Path(studio["truth"])
    result: dict[str, Any] = {
        "captures": captures,
        "skews_stated": skews,
        "seconds": {"median": median(seconds), "max": max(seconds)},
        "warm_up_s": {"median": median(warm_up_s), "max": max(warm_up_s)},
        "spread_ms": {"median": median(spreads_ms), "max": max(spreads_ms)},
    }
    if reconstruct:
        report = command("reconstruct", str(scratch / f"capture{captures - 1}"), "--out", str(scratch / "head"))
        error = error_mm(truth, scratch / "head" / "head.ply")
        result["error_mm"] = {name: round(value, 3) for name, value in error.items()}
        result["warnings"] = [warning["code"] for warning in report["warnings"]]
    return {"figures": result}
