"""The exceptions a user may see."""


class UserError(Exception):
    """Bad input or environment. The message is one line that names the file (and key) and the
    mend.
    """


class Stopped(Exception):
    """A command ended in good order before all was done. The message is one line that says how to
    go on; status: the exit status, 128 and the number of the signal that ended it, else 1.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


def shown(text: str, most: int = 100) -> str:
    """What others wrote, for a message: on one line, without control characters, of at most `most`
    characters.
    """
    text = " ".join(text[: 4 * most].split())
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def quoted(value: object, most: int = 100) -> str:
    """shown() of a value as Python writes it: texts in quotation marks."""
    try:
        return shown(repr(value), most)
    except (RecursionError, ValueError):  # nested deeply, or a number of thousands of digits
        return f"a {type(value).__name__}"
