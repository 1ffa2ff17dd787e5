"""What labels, notes and names may be."""

import pytest

from rig.errors import InputError
from server.services.captures import CaptureMetadata
from server.services.texts import TEXT_MOST, check_texts
from server.services.work import ReconstructionRequest


@pytest.mark.parametrize("text", ["a\0b", "\x1b[31m", "\x7f", "half \ud800", "a" * (TEXT_MOST + 1)])
def test_what_no_database_keeps_is_refused_and_named(text: str) -> None:
    with pytest.raises(InputError, match="form: label: "):
        check_texts({"label": text, "consent": "signed"})
    for made in (
        lambda: CaptureMetadata(label=text),
        lambda: CaptureMetadata.of({"label": text}),
        ReconstructionRequest(name=text).check,
    ):
        with pytest.raises(InputError, match=r"(label|name): "):
            made()


@pytest.mark.parametrize("text", ["", "Zoë 👩‍🔬", "signed by her father,\n\tfor research", None])
def test_notes_have_lines_and_any_script(text: str | None) -> None:
    check_texts({"consent": text})
