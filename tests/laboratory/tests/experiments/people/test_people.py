"""The experiment on people: which rows there are, how a result is judged, and what the summary calls silently wrong."""

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.head_model.model import HeadModel, load_model
from pipeline.settings import Settings
from pipeline.warnings import WARNING_CODES
from rig.capture import Capture
from rig.errors import EigenheadError, InputError
from rig.rig import Rig
from rig.studio.scene.subject import HAIRSTYLES
from rig.studio.scene.visible import VisiblePoints
from tests.laboratory.experiments.people import people as experiment
from tests.laboratory.experiments.people.people import (
    SPEAKING,
    figures,
    is_warned,
    is_wrong,
    people,
    select_cases,
    table,
)
from tests.laboratory.experiments.people.people_subjects import (
    EVIDENCE,
    STUDIO_KINDS,
    CaptureWithTruth,
    Case,
    capture_cases,
    seen_vertices,
    studio_cases,
)
from tests.laboratory.experiments.records import Bench
from tests.support.scenes import ellipsoid, fan
from tests.support.shared_data import shared

if TYPE_CHECKING:
    from rig.render.renderer import Renderer

RIGHT = {"turn_deg": 0.5, "shift_mm": 0.4, "face_median_mm": 0.2, "face_p90_mm": 0.5, "deviation_mm": 0.2,
         "deviations_off": 0.7, "cover_95": 0.95, "warnings": [], "seconds": 20.0}  # fmt: skip


def row(kind: str = "front-3", evidence: str = "plates", **changes: object) -> dict:
    return {"name": "n", "subject": "s", "kind": kind, "evidence": evidence, **RIGHT, **changes}


def planted() -> CaptureWithTruth:
    """An ellipsoid in front of a fan; skin is what lies above the middle, hair below."""
    mesh, rig = ellipsoid(4), fan()
    above = mesh.vertices[:, 1] > 0.0
    points = VisiblePoints(
        mesh.vertices.astype(np.float32), mesh.normals().astype(np.float32),
        np.where(above, 0, 1).astype(np.uint8), np.full(len(above), 2, np.uint8),
    )  # fmt: skip
    pictures = {name: np.zeros((240, 320, 3), np.uint8) for name in rig.names}
    masks = {name: np.ones((240, 320), bool) for name in rig.names}
    capture = Capture(pictures, {name: (picture,) for name, picture in pictures.items()})
    return CaptureWithTruth(capture, rig, masks, mesh, np.ones(len(above), bool), points, {})


@pytest.mark.parametrize("evidence", EVIDENCE)
def test_a_person_comes_with_the_evidence_asked_for_alone(evidence: str) -> None:
    person = planted().person(("cam01", "cam03"), evidence)
    assert set(person.capture.images) == {"cam01", "cam03"} == set(person.rig.names)
    assert bool(person.capture.backgrounds) == (evidence == "plates")
    assert bool(person.capture.masks) == (evidence == "masks")


def test_the_seen_face_is_bare_and_seen_by_two_of_the_cameras() -> None:
    shot = planted()
    seen = seen_vertices(shot.mesh_world, shot.visible, shot.rig.subset(["cam00", "cam01"]))
    x, y, _ = shot.mesh_world.vertices.T
    assert seen.any()
    assert (y[seen] > -3.0).all()
    assert x[seen].max() < 60.0, "cameras 50 and 75 degrees to the right see nothing of the left side"
    assert not seen_vertices(shot.mesh_world, shot.visible, shot.rig.subset(["cam03"])).any(), "one camera has no depth"


@pytest.mark.parametrize(
    ("change", "wrong"),
    [({}, False), ({"turn_deg": 3.1}, True), ({"shift_mm": 5.1}, True), ({"deviations_off": 3.1}, True)],
)
def test_a_result_is_wrong_by_its_pose_or_by_its_own_statement_and_only_its_own_warnings_speak_of_it(
    change: dict, wrong: bool
) -> None:
    assert is_wrong(row(**change)) == wrong
    assert not is_warned(row(warnings=["camera-gain", "mask-contradicted", "eyes-closed"]))
    assert all(is_warned(row(warnings=["camera-gain", code])) for code in SPEAKING)
    assert set(SPEAKING) - {"pose-doubtful"} <= set(WARNING_CODES)


def test_the_summary_counts_what_is_silently_wrong() -> None:
    rows = [
        row(),
        row(turn_deg=2.0),
        row(turn_deg=170.0, shift_mm=150.0, warnings=["camera-gain"]),
        row(turn_deg=90.0, warnings=["pose-doubtful"]),
        row("circle-8", "masks", deviations_off=5.0),
        {"name": "n", "subject": "s", "kind": "front-3", "evidence": "neither", "refused": "no view", "seconds": 1.0},
        {"name": "n", "subject": "s", "kind": "front-3", "evidence": "masks", "crashed": "KeyError: 3", "seconds": 1.0},
    ]
    found = figures(rows)
    assert found["rows"] == 7
    assert (found["refused"], found["crashed"], found["silent_wrong"]) == (1, 1, 2)
    assert found["front-3_plates_silent_wrong"] == 1
    assert found["front-3_plates_unwarned_share"] == 0.75
    assert found["front-3_plates_worst_unwarned_turn_deg"] == 170.0
    assert found["front-3_plates_worst_unwarned_shift_mm"] == 150.0
    assert found["front-3_plates_turn_deg"] == 46.0, "the median of 0.5, 2, 90 and 170"
    assert found["circle-8_masks_silent_wrong"] == 1
    assert found["masks_crashed"] == 1
    assert "front-3_neither_turn_deg" not in found, "a refusal has no pose"
    json.dumps(found, allow_nan=False)


def test_the_table_marks_what_is_silently_wrong_and_says_how_others_ended() -> None:
    rows = [
        row("circle-16"),
        row("circle-8", turn_deg=9.0),
        row(refused="no view shows a head"),
        row("circle-8", turn_deg=9.0, warnings=["pose-doubtful"]),
    ]
    lines = table(rows).splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines] == ["| front-3", "| circle-8", "| circle-8", "| circle-16"]
    assert ["! s" in line for line in lines] == [False, True, False, False]
    assert "refused: no view shows a head" in lines[0]


def cases() -> list[Case]:
    subjects = ("anna", "ben")
    read = partial(planted().person, fan().names)
    return [Case(s, k, e, partial(read, e)) for s in subjects for k in ("front-3", "circle-8") for e in EVIDENCE]


def test_words_of_one_sort_widen_and_words_of_different_sorts_narrow() -> None:
    assert len(select_cases(cases(), ())) == 12
    masked = {case.name for case in select_cases(cases(), ("anna", "masks"))}
    assert masked == {"anna front-3 masks", "anna circle-8 masks"}
    assert len(select_cases(cases(), ("anna", "ben", "circle-8"))) == 6
    with pytest.raises(InputError, match="nobody is none of"):
        select_cases(cases(), ("nobody",))


def test_captures_come_whole_and_by_subsets_with_every_evidence_and_none_without_a_truth(tmp_path: Path) -> None:
    found = [*capture_cases(shared("data/captures/circle-hair"))]
    kinds = list(dict.fromkeys(case.kind for case in found))
    circles = ["circle-24", "circle-5", "circle-8", "circle-11", "circle-12", "circle-16"]
    assert kinds == [*circles, "front-3", "front-5", "front-8", "front-11"]
    assert len(found) == 3 * len(kinds)
    assert [case.kind for case in capture_cases(shared("data/captures/three-brows"))] == ["front-3"] * 3
    (tmp_path / "anna").mkdir()
    with pytest.raises(InputError, match=r"anna: anna\.truth/head\.ply is missing"):
        list(capture_cases(tmp_path / "anna"))


@pytest.mark.gl
def test_the_studio_has_rigs_of_every_kind_and_hair_that_there_is_and_each_case_its_name(renderer: "Renderer") -> None:
    kinds = {studio.kind for studio in STUDIO_KINDS}
    assert {"front-3", "front-5", "front-11", "circle-8", "circle-16", "circle-32"} <= kinds
    assert all(len(studio.directions_deg) == int(studio.kind.partition("-")[2]) for studio in STUDIO_KINDS)
    assert {name for studio in STUDIO_KINDS for name in studio.hairstyle} <= set(HAIRSTYLES)
    assert max(abs(angle) for studio in STUDIO_KINDS for angle in studio.pose_deg) == 45.0
    assert {min(s.distance_mm for s in STUDIO_KINDS), max(s.distance_mm for s in STUDIO_KINDS)} == {400.0, 3000.0}
    found = [case.name for case in studio_cases(load_model(), None, renderer, 2)]
    assert len(set(found)) == len(found) == 2 * len(EVIDENCE) * len(STUDIO_KINDS)


class Broken(Exception):
    """No error of ours."""


@pytest.mark.gl
@pytest.mark.parametrize(
    ("error", "ended"), [(EigenheadError("no view " * 40), "refused"), (Broken("three"), "crashed")]
)
def test_refusals_and_crashes_are_rows(
    error: Exception, ended: str, renderer: "Renderer", monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(capture: Capture, rig: Rig, model: HeadModel, settings: Settings, renderer: "Renderer") -> None:
        raise error

    monkeypatch.setattr(experiment, "run_job", fail)
    case = Case("anna", "front-7", "masks", lambda: planted().person(fan().names, "masks"))
    found = experiment.judge_case(case, load_model(), Settings(), renderer)
    assert set(found) == {ended, "seconds"}
    assert str(error)[:100] in found[ended]
    assert len(found[ended]) <= 120


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(1200)  # two whole jobs, beside another test
def test_two_rows_are_computed_and_kept(renderer: "Renderer", tmp_path: Path) -> None:
    run = partial(
        people, load_model(), None, [], renderer=renderer, bench=Bench(folder=tmp_path),
        only=("front-11", "studio-plain-0", "plates", "masks"), detail="span",
    )  # fmt: skip
    found = run()
    rows = found["rows"]
    assert isinstance(rows, list)
    assert [row["evidence"] for row in rows] == ["plates", "masks"]
    for name, most in {"turn_deg": 3.0, "shift_mm": 5.0, "face_median_mm": 2.0}.items():
        assert all(each[name] < most for each in rows), name
    assert found["figures"]["silent_wrong"] == 0
    kept = json.loads((tmp_path / "people-span.json").read_text())["rows"]
    assert len(kept) == 2
    assert run()["rows"] == rows, "seconds included: nothing was computed again"
