"""Measures how a default job's processor seconds and memory grow with the number of views and with the size of the
pictures.

The studio photographs the same head with more cameras, or with larger sensors; the command line reconstructs it with
one thread. Exponents are slopes of log seconds over log views or log pixels, by least squares, from twice the smallest
size on: 1 is proportional growth, and less than 1 means a fixed part.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.head_model.model import HeadModel
from rig.formats.captures.capture_folder import write_capture
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import DEFAULT_DIRECTIONS_DEG, HEIGHT, WIDTH, default_layout, rig_from_directions
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.speed.scaling import JobCommand, run_job
from tests.support.subjects import random_subjects

Kind = Literal["views", "pixels"]
VIEWS = (5, 8, 11, 16, 24, 40)
MEGAPIXELS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 24.0)
SEED = 7
TURN_DEG = 7.0  # each further round of the default directions is turned by so much, or nobody would stand there


@dataclass(frozen=True, slots=True)
class Size:
    """Holds one size of a job: number of views and millions of pixels of each. ``kind`` says which of both grows."""

    kind: Kind
    views: int
    megapixels: float

    @property
    def name(self) -> str:
        """Returns the size in words: number of views and millions of pixels."""
        return f"{self.views} views of {self.megapixels:.2g} Mpx"

    def rig(self) -> Rig:
        """Returns the default rig with so many cameras and pixels; further cameras stand between the default ones."""
        rounds = -(-self.views // len(DEFAULT_DIRECTIONS_DEG))
        turned = [
            (azimuth + TURN_DEG * ((turn + 1) // 2) * (-1) ** turn, elevation + 3.0 * turn)
            for turn in range(rounds)
            for azimuth, elevation in DEFAULT_DIRECTIONS_DEG
        ]
        rig = default_layout() if rounds == 1 else rig_from_directions(turned)
        kept = rig.subset(rig.names[: self.views])
        return kept.scaled(float(np.sqrt(1e6 * self.megapixels / (WIDTH * HEIGHT))))


def sizes(only: Sequence[str] = ()) -> list[Size]:
    """Returns the sizes of each kind, or those whose kind or name is in ``only``."""
    standard = WIDTH * HEIGHT / 1e6
    all_sizes = [Size("views", count, standard) for count in VIEWS]
    all_sizes += [Size("pixels", len(DEFAULT_DIRECTIONS_DEG), megapixels) for megapixels in MEGAPIXELS]
    return [size for size in all_sizes if not only or {size.kind, size.name} & {*only}]


def growth(
    model: HeadModel, chosen: Sequence[Size], *, command: JobCommand, renderer: Renderer, bench: Bench
) -> Outcome:
    """Returns processor seconds, by stage, and peak memory of a default job for each size.

    Raises JobFailed.
    """
    records = bench.records("growth", key_of(model.sha256, SEED))
    rows: list[Row] = []
    for done, size in enumerate(chosen):
        rows.append(
            {"name": size.name, "kind": size.kind, "views": size.views, "megapixels": size.megapixels}
            | records.row(size.name, lambda size=size: _measured(size, model, command, renderer), done / len(chosen))
        )
    figures: dict[str, float] = {}
    for kind, quantity in (("views", "views"), ("pixels", "megapixels")):
        of_kind = [row for row in rows if row["kind"] == kind]
        figures |= {f"peak_mb_{row['name'].replace(' ', '_')}": row["peak_mb"] for row in of_kind}
        if len(of_kind) > 1:
            figures[f"exponent_of_{kind}"] = exponent(of_kind, quantity, "cpu_s")
            figures[f"exponent_of_{kind}_memory"] = exponent(of_kind, quantity, "peak_mb")
    return {"figures": figures, "rows": rows, "markdown": _table(rows)}


def exponent(rows: Sequence[Mapping[str, float]], quantity: str, cost: str) -> float:
    """Returns the exponent with which a cost grows with a quantity, over rows with at least twice the smallest
    quantity."""
    counted = [row for row in rows if row[quantity] >= 2.0 * rows[0][quantity]]
    logs = np.log([[row[quantity], row[cost]] for row in counted])
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])


def _subject(model: HeadModel) -> Subject:
    full = model.levels["full"]
    vertices = model.vertices(random_subjects(1, SEED)[0].coefficients)
    marks = {name: vertices[row] for name, row in model.landmarks.items()}
    return Subject(Mesh(vertices, full.faces), marks, full.face_region, f"seed-{SEED}")


def _measured(size: Size, model: HeadModel, command: JobCommand, renderer: Renderer) -> Row:
    with tempfile.TemporaryDirectory() as scratch:
        taken = simulate(_subject(model), size.rig(), PRESET, np.random.default_rng(SEED), renderer=renderer)
        capture = Path(scratch) / "capture"
        write_capture(capture, taken.capture, taken.rig)
        del taken
        found = run_job(capture, command, 1, None)
    stages = {each["name"]: each["cpu_s"] for each in found["stages"]}
    return {"cpu_s": found["cpu_s"], "wall_s": found["wall_s"], "peak_mb": found["peak_mb"], "stages": stages}


def _table(rows: Sequence[Row]) -> str:
    names = list(rows[0]["stages"])
    header = ("pictures", "CPU, s", "peak, MB", *names)
    return markdown.table(
        header,
        [[row["name"], row["cpu_s"], row["peak_mb"], *(row["stages"].get(name) for name in names)] for row in rows],
    )
