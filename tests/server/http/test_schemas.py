"""Documents on the wire: what no pattern tells of them."""

import pytest
from pydantic import ValidationError

from server.http.schemas import JobWebhook
from server.services.webhooks import signed_headers

URL = "https://lab.example/hook"


@pytest.mark.parametrize("secret", ["A" * 32, "A" * 34 + "==", "A" * 35 + "=", "A" * 36])
def test_a_secret_that_is_taken_can_sign(secret: str) -> None:
    taken = JobWebhook(url=URL, secret=f"whsec_{secret}").secret
    assert taken is not None
    assert signed_headers("id", 1, b"{}", taken)["webhook-signature"].startswith("v1,")


@pytest.mark.parametrize("secret", ["A" * 33, "A" * 34, "A" * 35, "A" * 33 + "==", "A" * 34 + "="])
def test_a_secret_that_is_no_base64_is_refused(secret: str) -> None:
    with pytest.raises(ValidationError, match="is no base64 after whsec_"):
        JobWebhook(url=URL, secret=f"whsec_{secret}")
