"""Which lids are told as an expression."""

from pipeline.stages.evidence import told_lids


def test_lids_a_little_down_are_no_blink() -> None:
    assert told_lids({"left": 0.25, "right": 0.3}) == {"left": 0.0, "right": 0.0}
    assert told_lids({"left": 0.5, "right": 1.0}) == {"left": 0.5, "right": 1.0}
