"""Suggested places become points only by being taken, and never against what somebody picked."""

from server.console.pages.features import drop_suggestions, open_suggestions, take_suggestions

SUGGESTED = {"pronasale": {"cam00": [10.0, 20.0], "cam01": [11.0, 21.0]}, "gnathion": {"cam00": [12.0, 40.0]}}
PICKED = {"pronasale": {"cam01": [99.0, 98.0]}}


def test_what_somebody_picked_is_not_suggested_anew() -> None:
    assert open_suggestions(SUGGESTED, PICKED) == {
        "pronasale": {"cam00": [10.0, 20.0]},
        "gnathion": {"cam00": [12.0, 40.0]},
    }
    assert open_suggestions(SUGGESTED, SUGGESTED) == {}


def test_all_are_taken_but_picks_stay() -> None:
    taken = take_suggestions(PICKED, SUGGESTED)
    assert taken == SUGGESTED | {"pronasale": {"cam00": [10.0, 20.0], "cam01": [99.0, 98.0]}}
    assert PICKED == {"pronasale": {"cam01": [99.0, 98.0]}}


def test_one_is_taken_in_one_view() -> None:
    assert take_suggestions({}, SUGGESTED, "pronasale", "cam01") == {"pronasale": {"cam01": [11.0, 21.0]}}
    assert take_suggestions({}, SUGGESTED, "pronasale", "cam07") == {}
    assert take_suggestions({}, SUGGESTED, "gnathion") == {"gnathion": {"cam00": [12.0, 40.0]}}


def test_rejected_ones_are_gone() -> None:
    assert drop_suggestions(SUGGESTED, "pronasale", "cam00") == SUGGESTED | {"pronasale": {"cam01": [11.0, 21.0]}}
    assert drop_suggestions(SUGGESTED, "gnathion", "cam00") == {"pronasale": SUGGESTED["pronasale"]}
    assert drop_suggestions(SUGGESTED) == {}
    assert "gnathion" in SUGGESTED
