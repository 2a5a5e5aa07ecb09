"""Functions that numba compiles at their first call."""

import numpy as np
import pytest

from flexroad.tasks.compiled import compiled


@compiled()
def _reciprocal(value):
    return 1.0 / value


@compiled(error_model="numpy")
def _reciprocals(values):
    total = 0.0
    for value in values:
        total += _reciprocal(value)
    return total


def test_call_of_compiled_function_by_another_equals_python():
    values = np.array([1.0, 3.0, 7.0])
    assert _reciprocals(values) == sum(1.0 / value for value in values)


def test_function_called_by_a_compiled_one_can_be_called_from_python():
    assert _reciprocals(np.array([2.0])) == _reciprocal(2.0) == 0.5


def test_error_model_is_that_of_the_function_itself():
    with pytest.raises(ZeroDivisionError):
        _reciprocals(np.zeros(1))
