"""What a short command loads decides how long it takes: nothing that it does not use."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from server.processes import python_environment

HEAVY = ("numpy", "scipy", "numba", "cv2", "pydantic", "sqlalchemy", "moderngl", "rich", "fastapi", "httpx")
RUN = """
import json, sys
sys.argv = ["eigenhead", *json.loads(sys.argv[1])]
try:
    from server.cli.main import main
    main()
except SystemExit:
    pass
print(json.dumps(sorted({name for name in sys.modules if name in json.loads(HEAVY)})), file=sys.stderr)
"""


def heavy_modules(*arguments: object) -> set[str]:
    code = f"HEAVY = {json.dumps(HEAVY)!r}\n{RUN}"
    command = [sys.executable, "-c", code, json.dumps([str(argument) for argument in arguments])]
    done = subprocess.run(command, env=python_environment(), capture_output=True, text=True, timeout=60, check=True)
    return set(json.loads(done.stderr.splitlines()[-1]))


@pytest.mark.parametrize(
    "arguments", [("--help",), ("reconstruct", "--help"), ("nonsense",), ("reconstruct",), ("model", "list")]
)
def test_help_wrong_usage_and_the_list_of_models_load_nothing_heavy(arguments: tuple[str, ...]) -> None:
    assert heavy_modules(*arguments) == set()


def test_doctor_and_convert_load_little(tmp_path: Path) -> None:
    assert heavy_modules("doctor", "--data", tmp_path) <= {"pydantic", "numpy", "cv2"}
    assert heavy_modules("convert", tmp_path, "--out", tmp_path / "out") <= {"numpy"}


def test_the_pipeline_loads_no_package_for_one_function() -> None:
    code = "import sys; from pipeline import reconstruct; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=python_environment(), capture_output=True, text=True, timeout=60, check=True)
    assert not {"scipy.stats", "scipy.optimize", "scipy.ndimage", "trimesh"} & set(done.stdout.split())
