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


def test_function_called_by_compiled_ones_alone_has_no_cache(tmp_path, monkeypatch):
    """Its code is part of the caller's."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))

    @compiled()
    def double(value):
        return 2.0 * value

    @compiled()
    def quadruple(value):
        return double(double(value))

    assert quadruple(3.0) == 12.0
    assert {path.name.split("-")[0] for path in tmp_path.rglob("*.nbi")} == {
        "test_compiled.test_function_called_by_compiled_ones_alone_has_no_cache.locals.quadruple"
    }
