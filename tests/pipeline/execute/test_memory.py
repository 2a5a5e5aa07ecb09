"""The memory of workers follows the limits of control groups (made files)."""

import pytest

from flexroad.pipeline.execute import start

MIB = 2**20


@pytest.fixture
def available(tmp_path, monkeypatch):
    monkeypatch.setattr(start, "MEMORY_LIMIT", 900 * MIB)

    def call(name: str, **limits: str) -> int:
        """Return the memory of a process in the control group ``name``; ``limits`` by file, / as __."""
        for file, text in limits.items():
            path = tmp_path / file.replace("__", "/").replace("memory_", "memory.")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        (tmp_path / "own").write_text(name)
        return start.available_bytes(tmp_path, tmp_path / "own")

    return call


def test_available_memory_is_least_limit_of_the_group_and_those_around(available):
    unit = "0::/system.slice/roads.service\n"
    assert available(unit) == 900 * MIB
    assert available(unit, system__slice__memory_max="max\n") == 900 * MIB
    files = {"system.slice__roads.service__memory_max": f"{300 * MIB}\n"}
    assert available(unit, **files) == 300 * MIB
    assert available(unit, **{"system.slice__memory_high": f"{200 * MIB}\n"}) == 200 * MIB
    assert available("0::/\n") == 900 * MIB


def test_available_memory_of_first_version_of_control_groups(available):
    own = "5:cpu:/x\n4:memory:/slurm/job_7\n0::/\n"
    assert available(own, **{"memory__slurm__job_7__memory_limit_in_bytes": f"{400 * MIB}\n"}) == 400 * MIB


def test_available_memory_without_readable_files_is_that_of_dask(available):
    assert available("nothing") == 900 * MIB
    assert available("0::/../../x\n", **{"x__memory_max": "many\n"}) == 900 * MIB
