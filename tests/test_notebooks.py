"""The notebooks run from top to bottom, and draw; in the repository they have no outputs."""

import ast
import base64
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
PNG_LEAST = 5_000  # bytes: an empty figure of these sizes has fewer


def nbformat() -> Any:
    return pytest.importorskip("nbformat", reason="deploy/setup.sh --docs installs it")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path: Path) -> None:
    notebook = nbformat().read(path, as_version=4)
    nbformat().validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert cells
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_code_compiles_and_finds_what_it_imports(path: Path) -> None:
    cells = [cell.source for cell in nbformat().read(path, as_version=4).cells if cell.cell_type == "code"]
    tree = ast.parse("\n".join(line for cell in cells for line in cell.splitlines() if not line.startswith("%")))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert imports
    for node in imports:
        module = importlib.import_module(str(node.module))
        assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []


@pytest.mark.nightly
@pytest.mark.gl
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore")  # Jupyter's own
def test_the_first_head_is_made_plotted_and_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the commands of docs/python.md, in a shell that knows no `eigenhead`."""
    pytest.importorskip("nbclient", reason="deploy/setup.sh --docs installs it")
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"<!-- code: notebook -->\n```sh\n(.*?)```", text, re.DOTALL)
    for name, target in ((".venv", Path(sys.prefix)), ("docs", ROOT / "docs")):
        (tmp_path / name).symlink_to(target)
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path / "matplotlib"))
    monkeypatch.setenv("PATH", os.defpath)
    subprocess.run(["bash", "-euo", "pipefail", "-c", code], cwd=tmp_path, check=True, timeout=800)
    notebook = nbformat().read(tmp_path / "out" / "first_head.ipynb", as_version=4)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    plots = [base64.b64decode(output.data["image/png"]) for output in outputs if "image/png" in output.get("data", {})]
    assert len(plots) == 4
    assert min(map(len, plots)) > PNG_LEAST
    for i, plot in enumerate(plots):
        (tmp_path / f"plot-{i}.png").write_bytes(plot)
    printed = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    median_mm = float(printed.partition("median ")[2].partition(" mm")[0])
    assert median_mm < 0.3  # scan-a and draw-b end at 0.16 and 0.21 with this level
    assert (tmp_path / "out" / "heads" / "anna" / "head.ply").is_file()
