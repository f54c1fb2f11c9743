"""Errors by their type, their cause and the facts that they name, whatever the words."""

from contextlib import contextmanager

import pytest


@contextmanager
def refusal(error, *facts, cause=None):
    """Expect this error, which names the facts: a file, a key, a value; `cause` is the type it comes from."""
    with pytest.raises(error) as caught:
        yield caught
    said = str(caught.value)
    assert [fact for fact in facts if str(fact) not in said] == [], said
    if cause is not None:
        assert isinstance(caught.value.__cause__, cause), repr(caught.value.__cause__)
