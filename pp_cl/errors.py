"""The one exception a user may see."""


class UserError(Exception):
    """Bad input or environment. The message is one line that names the file (and key) and the
    mend.
    """
