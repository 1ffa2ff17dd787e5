"""What a text from outside must be before it is stored or sent on."""


def encodes(text: str) -> bool:
    """Whether a text can be written as UTF-8: an escape of JSON can name half of a character, which cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str) -> str:
    """The text with what cannot be written as UTF-8 escaped, so that a message can quote it."""
    return text.encode("utf-8", "backslashreplace").decode()
