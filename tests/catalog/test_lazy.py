"""Libraries are imported at their first use."""

import gc
import pickle
import subprocess
import sys
import wave

import pytest

from flexroad.catalog.lazy import lazy


def test_library_is_imported_at_its_first_use():
    code = (
        "import sys; from flexroad.catalog.lazy import lazy; wave = lazy('wave'); "
        "print('wave' in sys.modules); wave.Error; print('wave' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


def test_submodule_is_found_below_its_library():
    assert lazy("xml").etree.ElementTree.fromstring("<a/>").tag == "a"


def test_unknown_name_raises_the_error_of_the_module():
    with pytest.raises(AttributeError, match="module 'wave' has no attribute 'nothing'"):
        _ = lazy("wave").nothing


def test_missing_library_is_named_at_its_first_use():
    library = lazy("no_such_library")
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        _ = library.name


def test_missing_import_of_a_submodule_is_not_hidden(tmp_path, monkeypatch):
    (tmp_path / "outer_package").mkdir()
    (tmp_path / "outer_package" / "__init__.py").touch()
    (tmp_path / "outer_package" / "inner.py").write_text("import no_such_library")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        _ = lazy("outer_package").inner


def test_names_are_set_in_the_library_itself(monkeypatch):
    monkeypatch.setattr(lazy("wave"), "open", None)
    assert wave.open is None
    monkeypatch.undo()
    assert wave.open is not None


def test_pickled_library_is_imported_where_it_is_used():
    assert pickle.loads(pickle.dumps(lazy("wave"))).Error is wave.Error


def test_tools_that_look_for_marks_do_not_import():
    assert not hasattr(lazy("no_such_library"), "__wrapped__")


def test_garbage_is_not_collected_during_an_import(tmp_path, monkeypatch):
    (tmp_path / "asking.py").write_text("import gc; enabled = gc.isenabled()")
    (tmp_path / "failing.py").write_text("raise OSError")
    monkeypatch.syspath_prepend(tmp_path)
    assert not lazy("asking").enabled
    assert gc.isenabled()
    with pytest.raises(OSError):  # noqa: PT011 (any)
        _ = lazy("failing").name
    assert gc.isenabled()
