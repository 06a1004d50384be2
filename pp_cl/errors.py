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
