"""Annotations as checks: what the fast tests hold every call of rig, pipeline and calibration to."""

from pathlib import Path

from beartype import BeartypeConf, beartype

ROOT = Path(__file__).resolve().parents[2]

# PEP 484: where a float is wanted a whole number will do.
check_types = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked_modules() -> list[str]:
    """The modules whose annotations, shapes included, every call in the tests must obey: all of rig, pipeline and
    calibration but those with compiled kernels, which a wrapped function would break."""
    files = [path for room in ("rig", "pipeline", "calibration") for path in (ROOT / room).rglob("*.py")]
    plain = [path for path in files if path.name != "__init__.py" and "njit" not in path.read_text(encoding="utf-8")]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in plain]
