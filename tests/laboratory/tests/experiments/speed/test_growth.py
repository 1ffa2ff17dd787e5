"""Jobs of growing size: rigs of so many views and pixels, and exponents of costs that are known."""

import json
import sys
from pathlib import Path

import pytest

from pipeline.compute.trace import FORMAT
from pipeline.head_model.model import load_model
from rig.render.renderer import Renderer
from tests.laboratory.experiments.records import Bench
from tests.laboratory.experiments.speed.growth import VIEWS, Size, exponent, growth, sizes
from tests.laboratory.experiments.speed.scaling import JobCommand


@pytest.mark.parametrize("size", [Size("views", count, 0.786432) for count in VIEWS], ids=lambda size: size.name)
def test_further_cameras_stand_apart_from_the_others(size: Size) -> None:
    rig = size.rig()
    assert len(rig) == size.views
    assert rig.names[0] == "cam00"
    centres = [camera.centre_world for camera in rig]
    apart_mm = min(sum((a - b) ** 2) ** 0.5 for k, a in enumerate(centres) for b in centres[:k])
    assert apart_mm > 40.0


def test_pictures_have_so_many_pixels() -> None:
    for size in sizes(["pixels"]):
        for camera in size.rig():
            assert camera.intrinsics.width * camera.intrinsics.height == pytest.approx(1e6 * size.megapixels, rel=0.01)
    assert {size.kind for size in sizes()} == {"views", "pixels"}


def test_exponents_of_known_costs() -> None:
    rows = [{"views": n, "cpu_s": 3.0 * n**1.5, "peak_mb": 700.0} for n in (5, 8, 10, 20, 40)]
    assert exponent(rows, "views", "cpu_s") == pytest.approx(1.5)
    assert exponent(rows, "views", "peak_mb") == pytest.approx(0.0, abs=1e-9)


@pytest.mark.gl
@pytest.mark.slow
def test_jobs_run_in_children_and_their_rows_are_kept(tmp_path: Path, renderer: Renderer) -> None:
    args = {"cpu_s": 1.0, "process_cpu_s": 1.0}
    stage = {"ph": "X", "cat": "stage", "name": "a", "tid": 1, "ts": 0, "dur": 1e6, "args": args}
    trace = {"format": FORMAT, "before_cpu_s": 0.5, "peak_memory_mb": 512.0, "traceEvents": [stage]}
    (tmp_path / "job.py").write_text(
        "import os, sys\n"
        "views = len(os.listdir(os.path.join(sys.argv[1], 'images')))\n"
        f"open({str(tmp_path / 'runs')!r}, 'a').write(f'{{views}} ')\n"
        f"document = {json.dumps(trace)!r}.replace('\"process_cpu_s\": 1.0', f'\"process_cpu_s\": {{views - 0.5}}')\n"
        "open(sys.argv[sys.argv.index('--trace') + 1], 'w').write(document)\n"
    )
    command = JobCommand([sys.executable, str(tmp_path / "job.py")], {"PATH": ""})
    chosen = [Size("views", count, 0.03) for count in (3, 6, 12)]
    found, _ = (
        growth(load_model(), chosen, command=command, renderer=renderer, bench=Bench(folder=tmp_path / "out"))
        for _ in range(2)
    )
    assert (tmp_path / "runs").read_text() == "3 6 12 "
    assert found["figures"]["exponent_of_views"] == pytest.approx(1.0)
    assert isinstance(found["rows"], list)
    assert [row["cpu_s"] for row in found["rows"]] == pytest.approx([3, 6, 12])
