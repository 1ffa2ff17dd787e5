"""How long stages take: what settings make, what is learnt, and who finds it."""

from pathlib import Path

import pytest

from pipeline.settings import Settings, settings_from_document
from server.tasks.stage_durations import COSTS_S, LEARNING, StageDurations, first_guess, kind_of, megapixels_of
from tests.support.services import small_capture


@pytest.mark.parametrize(
    ("document", "extra", "missing"),
    [
        ({}, {"parts", "depth", "bust"}, set()),
        ({"detail": "photo", "outputs": {"surface": "head"}}, {"parts"}, {"depth", "bust"}),
        ({"detail": "span", "outputs": {"surface": "head"}}, set(), {"parts", "depth", "bust"}),
        ({"detail": "span"}, {"parts", "depth", "bust"}, set()),
    ],
)
def test_the_settings_decide_which_stages_come(document: dict[str, object], extra: set[str], missing: set[str]) -> None:
    stages = first_guess(settings_from_document(document))
    assert extra <= stages.keys()
    assert not missing & stages.keys()
    assert [stage for stage in COSTS_S if stage in stages] == list(stages)


def test_what_one_process_learns_every_other_finds(tmp_path: Path) -> None:
    file, settings = tmp_path / "cache" / "durations.json", Settings()
    before = StageDurations(file).of(settings)
    StageDurations(file).learn(settings, {"depth": 14.0, "polish": 1.0})
    after = StageDurations(file).of(settings)
    assert after["depth"] == pytest.approx(14.0, rel=1e-4)
    assert after.keys() == before.keys()
    assert after["fit"] == pytest.approx(before["fit"] * 14.0 / before["depth"], rel=1e-3), "not measured: as the whole"
    assert StageDurations(file).of(settings, 3.0)["depth"] == pytest.approx(14.0 * 3.4 / 9.05, rel=1e-3)  # fewer pixels
    StageDurations(file).learn(settings, {"depth": 24.0})
    assert StageDurations(file).of(settings)["depth"] == pytest.approx(
        (1 - LEARNING) * 14.0 + LEARNING * 24.0, rel=1e-4
    )
    span = settings_from_document({"detail": "span"})
    assert kind_of(span) != kind_of(settings)
    assert StageDurations(file).of(span).keys() == first_guess(span).keys()


@pytest.mark.parametrize("text", ["", "[1]", '{"contour fine both": 3}', '{"contour fine both": {"depth": "long"}}'])
def test_a_damaged_file_is_no_harm(tmp_path: Path, text: str) -> None:
    file = tmp_path / "durations.json"
    file.write_text(text)
    assert StageDurations(file).of(Settings()) == first_guess(Settings())
    StageDurations(file).learn(Settings(), {"depth": 14.0})
    assert StageDurations(file).of(Settings())["depth"] == pytest.approx(14.0, rel=1e-4)


def test_where_nothing_can_be_written_this_process_still_learns(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    durations = StageDurations(tmp_path / "file" / "durations.json")
    durations.learn(Settings(), {"depth": 14.0})
    assert durations.of(Settings())["depth"] == pytest.approx(14.0, rel=1e-4)


def test_the_first_job_of_a_kind_goes_at_the_pace_of_the_others(tmp_path: Path) -> None:
    durations = StageDurations(tmp_path / "durations.json")
    span, fine = Settings(detail="span"), Settings(detail="fine")
    assert megapixels_of(small_capture(tmp_path / "shot")) == pytest.approx(3 * 24 * 24 / 1e6)
    plain = durations.of(fine)
    durations.learn(span, {stage: 0.25 * seconds for stage, seconds in durations.of(span).items()})
    durations_s = durations.of(fine)
    assert durations_s == pytest.approx({stage: 0.25 * seconds for stage, seconds in plain.items()}, abs=0.01)
