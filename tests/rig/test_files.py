"""A document's digest is of what it says, whatever its order."""

from rig.files import document_sha256


def test_order_and_kind_of_list_do_not_count_and_values_do() -> None:
    document = {"b": [1, 2.5], "a": {"y": None, "x": "Ä"}}
    same = {"a": {"x": "Ä", "y": None}, "b": (1, 2.5)}
    assert document_sha256(document) == document_sha256(same)
    assert document_sha256(document) != document_sha256(document | {"b": [1, 2.6]})
    # Of the two bytes {}: results of earlier versions name their settings so.
    assert document_sha256({}) == "44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a"
