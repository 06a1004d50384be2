"""Refusals: the error of a call, and the line of a command."""

import contextlib

import pytest
from support.runs import spoken

from pp_cl.errors import UserError


@contextlib.contextmanager
def refusing(*words):
    """The block raises a UserError, one line as all are (tests/test_errors.py), with the words."""
    with pytest.raises(UserError) as caught:
        yield
    for word in words:
        assert str(word) in str(caught.value), str(caught.value)


def failure(*words):
    """The one line of its own, the last on stderr, with which a command ends with status 2."""
    status, lines = spoken(words)
    told = [line for line in lines if line.startswith("pp-cl")]
    assert status == 2 and told == lines[-1:], (status, lines)
    return told[0]
