"""An error that nobody foresaw names the line of fgloc that it came from."""

import numpy as np
import pytest

from fgloc import se2
from fgloc.errors import ConfigError, EstimatorError, unexpected


def test_an_unforeseen_error_says_where_in_fgloc_it_came_from():
    with pytest.raises(TypeError) as caught:
        se2.compose(np.zeros(3), None)
    failure = unexpected(caught.value, "a run")
    assert isinstance(failure, EstimatorError)
    assert failure.__cause__ is caught.value
    assert ": TypeError(" in str(failure)
    assert "in fgloc/se2.py:" in str(failure)


def test_an_error_raised_on_purpose_stays_what_it_is():
    error = ConfigError("no such file")
    assert unexpected(error, "a run") is error
