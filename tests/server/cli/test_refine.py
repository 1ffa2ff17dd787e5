"""``eigenhead refine`` on capture folders: a planted camera error comes back, and captures of two rigs are refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.adjustment.gauge import image_distance
from calibration.silhouette_refinement.refine import Refinement, Residuals, TooFewCaptures
from calibration.silhouette_refinement.report import RefinementRun, refinement_page
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.captures.capture_folder import write_capture
from rig.messages.message import verbatim
from rig.studio.scene.layout import default_layout
from server.tasks.refine import refine_locally
from tests.server.cli.test_main import run
from tests.support.silhouette_subjects import captures_of, disturbed, rms

TRUE = default_layout()


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(300)
def test_cameras_come_back_and_the_page_says_so(renderer, tmp_path: Path) -> None:
    off = disturbed(TRUE, 0.5, np.random.default_rng(1))
    folders = [tmp_path / f"subject{i}" for i in range(3)]
    for folder, seen in zip(folders, captures_of(renderer, TRUE, 3, np.random.default_rng(5)), strict=True):
        masks = {name: silhouette.mask for name, silhouette in seen.items()}
        blank = np.full((768, 1024, 3), 128, np.uint8)
        write_capture(folder, Capture(dict.fromkeys(off.names, blank), masks=masks), off)
    out = tmp_path / "refined.json"
    done = run("refine", *map(str, folders), "--out", str(out), "--json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed["kept"]
    assert printed["held_out"]["after_px"] < 0.7 * printed["held_out"]["before_px"]
    refined = read_rig(out)
    assert rms(image_distance(refined, TRUE)) < 0.5 * rms(image_distance(off, TRUE))
    assert all(camera.covariance is not None for camera in refined)
    page = out.with_suffix(".html").read_text()
    assert "kept" in page
    assert not re.search(r"(src|href)\s*=|https?://|@import", page)
    for name in TRUE.names:
        assert f"<td>{name}</td>" in page


def test_captures_of_two_rigs_are_refused(tmp_path: Path) -> None:
    small = TRUE.subset(TRUE.names[:3]).scaled(0.05)
    masks = {camera.name: np.zeros((camera.intrinsics.height, camera.intrinsics.width), bool) for camera in small}
    for mask in masks.values():
        mask[10:30, 15:35] = True
    blank = {name: np.full((*mask.shape, 3), 128, np.uint8) for name, mask in masks.items()}
    other = disturbed(small, 0.5, np.random.default_rng(0))
    write_capture(tmp_path / "one", Capture(blank, masks=masks), small)
    write_capture(tmp_path / "two", Capture(blank, masks=masks), other)
    arguments = {"calibration": None, "focal": False, "model": None, "report": lambda stage, fraction: None}
    with pytest.raises(InputError, match="two: cam00: stands elsewhere"):
        refine_locally([tmp_path / "one", tmp_path / "two"], **arguments)
    with pytest.raises(TooFewCaptures):
        refine_locally([tmp_path / "one"], **arguments)


def test_a_rejected_change_says_so_and_keeps_the_rig() -> None:
    cameras = tuple((one, two) for one in TRUE.names for two in TRUE.names if one < two)
    px = np.random.default_rng(0).normal(0.0, 0.1, len(cameras))
    residuals = Residuals(cameras, px)
    proposed = disturbed(TRUE, 0.1, np.random.default_rng(1))
    found = Refinement(
        TRUE, proposed, residuals, replace(residuals, px=1.1 * px), 0.1, 0.11, 0.1, False, verbatim("no <better>"),
        dict(zip(TRUE.names, image_distance(proposed, TRUE).tolist(), strict=True)),
    )  # fmt: skip
    report = RefinementRun(found, TRUE, ("anna", "ben"), (verbatim("cam03 has moved"),))
    document = report.document()
    assert not document["kept"]
    assert document["rig"]["cameras"][0]["camera_from_world"]["translation"] == pytest.approx(
        TRUE["cam00"].camera_from_world.translation.tolist()
    )
    assert all(row["after_px"] > row["before_px"] for row in document["cameras"].values())
    assert all(row["equations"] == 10 for row in document["cameras"].values())
    page = refinement_page(report)
    assert "rejected: the calibration stays as it was" in page
    assert "no &lt;better&gt;" in page
    assert "cam03 has moved" in page
