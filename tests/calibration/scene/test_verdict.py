"""Whether a rig should be given what its photographs told: by the weakest camera, never good on an assumed scale."""

from dataclasses import replace

import numpy as np

from calibration.scene.scale import ASSUMED
from calibration.scene.verdict import judge_scene
from rig.messages.message import texts_of, verbatim
from tests.support.textured_wedge import solved


def test_a_calibration_from_a_scene_is_judged_by_what_it_does_not_know() -> None:
    found = solved()
    sharp = np.full(len(found.rig), 0.3)
    sound = replace(found, uncertainty=replace(found.uncertainty, pose_sigma_px=sharp))
    assert judge_scene(sound).word == "good"
    guessed = judge_scene(
        replace(sound, scale=replace(found.scale, source=ASSUMED[0], provenance=verbatim("an ASSUMPTION")))
    )
    assert (guessed.word, texts_of(guessed.missing)) == ("usable", ["the scale is an ASSUMPTION"])
    apart = judge_scene(replace(sound, left_out={"dark": verbatim("only 3 distinct points in it")}))
    assert (apart.word, texts_of(apart.missing)) == ("usable", ["dark: only 3 distinct points in it"])
    for px, word in ((0.8, "usable"), (1.4, "poor")):
        loose = replace(found.uncertainty, pose_sigma_px=np.where(np.arange(len(sharp)) == 2, px, sharp))
        judged = judge_scene(replace(found, uncertainty=loose))
        assert judged.word == word
        assert judged.missing[0].text.startswith(f"{found.rig.names[2]}: pose looser than")
