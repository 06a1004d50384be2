"""Refusals: check the error of a call and the last line of a command."""

import contextlib

import pytest
from support.runs import spoken

from pp_cl.errors import UserError


@contextlib.contextmanager
def refusing(*words):
    """Assert that the block raises a UserError that has all the words."""
    with pytest.raises(UserError) as caught:
        yield
    for word in words:
        assert str(word) in str(caught.value), str(caught.value)


def failure(*words):
    """Run a command that must end with status 2; returns its error line, the last on stderr."""
    status, lines = spoken(words)
    errors = [line for line in lines if line.startswith("pp-cl")]
    assert status == 2 and errors == lines[-1:], (status, lines)
    return errors[0]
