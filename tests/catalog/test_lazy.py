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


def test_library_is_used_like_the_module_itself(monkeypatch):
    assert lazy("xml").etree.ElementTree.fromstring("<a/>").tag == "a"
    assert pickle.loads(pickle.dumps(lazy("wave"))).Error is wave.Error
    monkeypatch.setattr(lazy("wave"), "open", None)
    assert wave.open is None
    monkeypatch.undo()
    assert wave.open is not None
    # Tools that look for such marks do not import the library.
    assert not hasattr(lazy("no_such_library"), "__wrapped__")


def test_missing_name_or_library_is_named(tmp_path, monkeypatch):
    (tmp_path / "outer_package").mkdir()
    (tmp_path / "outer_package" / "__init__.py").touch()
    (tmp_path / "outer_package" / "inner.py").write_text("import no_such_library")
    monkeypatch.syspath_prepend(tmp_path)
    for library, error, match in (
        ("wave", AttributeError, "module 'wave' has no attribute 'inner'"),
        ("no_such_library", ModuleNotFoundError, "no_such_library"),
        ("outer_package", ModuleNotFoundError, "no_such_library"),
    ):
        with pytest.raises(error, match=match):
            _ = lazy(library).inner


def test_garbage_is_not_collected_during_an_import(tmp_path, monkeypatch):
    (tmp_path / "asking.py").write_text("import gc; enabled = gc.isenabled()")
    (tmp_path / "failing.py").write_text("raise OSError")
    monkeypatch.syspath_prepend(tmp_path)
    assert not lazy("asking").enabled
    assert gc.isenabled()
    with pytest.raises(OSError):  # noqa: PT011 (any)
        _ = lazy("failing").name
    assert gc.isenabled()
