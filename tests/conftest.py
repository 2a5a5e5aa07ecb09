"""Fixtures shared by all tests: a small synthetic survey, a quick configuration, executors, storage."""

import os
import shutil
import signal
from pathlib import Path

import pytest
import yaml
from hypothesis import settings

from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.run.record import Run
from tests import changed, command_line, gpu
from tests.builders import LIGHT, copy_run, finish_run

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts background jobs with Ctrl-C ignored, and the processes of the tests would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests never assert on time. --hypothesis-profile is loaded after this.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

QUICK = {
    "extends": "defaults",
    "fit": {"method": "nurbs", "control_points": [12, 12], "iterations": 30},
    "variants": {
        "plane": {"fit": "plane", "sample": "corners"},
        "rgt": {"fit": "raster", "sample": "uniform"},
        "flexroad": {},
    },
}
"""The paper's three variants with a quick, inaccurate fit."""


def pytest_addoption(parser):
    helped = (
        "all soak tests; tests of changed areas (tests/changed.py); or all, and record the commit if all pass"
    )
    parser.addoption("--soak", choices=("all", "changed", "record"), default="all", help=helped)


def pytest_collection_modifyitems(config, items):
    """Skip soak tests of unchanged areas; run files with slow tests first.

    Parallel test processes then end at about the same time.
    """
    if config.option.soak == "changed":
        skip_unchanged(items, changed.changed_files())
    if hasattr(config, "workerinput"):
        slow = {item.path for item in items if item.get_closest_marker("slow")}
        items.sort(key=lambda item: item.path not in slow)


def skip_unchanged(items, files):
    for item in items:
        marker = item.get_closest_marker("soak")
        test = item.path.relative_to(changed.ROOT).as_posix()
        if marker and not changed.is_due(*marker.args, files, test):
            item.add_marker(pytest.mark.skip("soak test of an unchanged area; `make soak` runs all"))


def pytest_terminal_summary(terminalreporter, exitstatus, config):
    """Record that all soak tests passed. A parallel test process has only its own tests' status."""
    if config.option.soak == "record" and not exitstatus and not hasattr(config, "workerinput"):
        skipped = [report.longrepr[2] for report in terminalreporter.stats.get("skipped", [])]
        # Few machines have a GPU.
        missed = [reason for reason in skipped if gpu.REASON not in reason]
        if config.option.keyword or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
            missed.append("only some of the tests ran")
        terminalreporter.write_line(f"not recorded: {missed[0]}" if missed else changed.record())


@pytest.fixture(scope="session", autouse=True)
def state_folder(tmp_path_factory):
    """The folder of the user's key, so that tests leave none in the home folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def flexroad():
    """The command line, run in this process; fails on a traceback."""
    return command_line.call


@pytest.fixture(scope="session")
def real_data() -> Path:
    folder = os.environ.get("FLEXROAD_REAL_DATA")
    if not folder:
        pytest.skip("FLEXROAD_REAL_DATA is not set")
    return Path(folder)


@pytest.fixture(scope="session")
def made_survey(tmp_path_factory) -> Path:
    """A folder with a survey of four adjacent tiles of 60 m with ground truth."""
    from flexroad.tools.synthetic.scenes import write_scenes

    folder = tmp_path_factory.mktemp("survey")
    write_scenes(folder, 4, seed=3, size_m=60)
    return folder


@pytest.fixture
def survey(made_survey, tmp_path) -> Path:
    """The catalog of a copy of the survey, for tests to change."""
    return shutil.copytree(made_survey, tmp_path / "survey") / "catalog.parquet"


@pytest.fixture(scope="session")
def light_run(made_survey, tmp_path_factory) -> Run:
    """A finished run of the four tiles with a light configuration; tests only read it."""
    return finish_run(tmp_path_factory.mktemp("light") / "run", made_survey)


@pytest.fixture
def own_run(light_run, made_survey, tmp_path) -> Run:
    """A copy of the finished run with a survey of its own, for tests to change."""
    return copy_run(light_run, made_survey, tmp_path)


@pytest.fixture
def quick_config(tmp_path) -> Path:
    path = tmp_path / "quick.yaml"
    path.write_text(yaml.safe_dump(QUICK, sort_keys=False))
    return path


@pytest.fixture(scope="session")
def light_config(tmp_path_factory) -> Path:
    """The file of ``LIGHT``."""
    path = tmp_path_factory.mktemp("config") / "light.yaml"
    path.write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    return path


@pytest.fixture(scope="session")
def cluster():
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, env=ONE_THREAD
    ) as cluster:
        yield cluster


@pytest.fixture
def processes(tmp_path):
    """Scheduler and worker processes for one test, which may kill them."""
    from tests.dask_processes import Processes

    started = Processes(tmp_path)
    yield started
    started.end()


@pytest.fixture(params=["serial", "dask"])
def executor(request):
    if request.param == "serial":
        return SerialExecutor()
    return DaskExecutor(scheduler=request.getfixturevalue("cluster").scheduler_address)


@pytest.fixture
def web(tmp_path_factory, monkeypatch):
    """A web server on loopback that records its requests."""
    from tests.recording_server import recording

    monkeypatch.setenv("GDAL_HTTP_MAX_RETRY", "0")
    with recording(tmp_path_factory.mktemp("web")) as recorder:
        yield recorder


@pytest.fixture(scope="session")
def storage_server():
    from tests.s3_server import storage

    with storage() as server:
        yield server


@pytest.fixture
def storage(storage_server, monkeypatch):
    """Object storage on loopback with configurable faults; S3 clients in this process use it."""
    storage_server.fail()
    settings = {
        "AWS_ENDPOINT_URL": storage_server.url,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "GDAL_HTTP_RETRY_DELAY": "0.01",
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("botocore.retryhandler.delay_exponential", lambda **_: 0.01)
    yield storage_server
    storage_server.fail()


@pytest.fixture
def bucket(storage, request):
    """A folder in a new bucket."""
    from flexroad.catalog.storage.paths import parse_location

    folder = parse_location(f"s3://{abs(hash(request.node.nodeid)):x}/area")
    folder.fs.mkdir(folder.parent.path)
    return folder
