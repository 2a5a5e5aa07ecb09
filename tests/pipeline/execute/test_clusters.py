"""Executor on running clusters (real processes on loopback); options of SLURM clusters."""

import ctypes
import os
import shutil
import sys
import time
from itertools import islice
from pathlib import Path

import cloudpickle
import psutil
import pytest

import flexroad
from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.models import Cluster
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute import DaskExecutor, clusters
from flexroad.pipeline.execute.clusters import open_cluster
from flexroad.pipeline.execute.slurm import slurm_options
from flexroad.pipeline.execute.workers import checksum_of_code
from tests.dask_processes import Processes, until, wait_for

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

# Workers cannot import this test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


@pytest.fixture
def impatient(monkeypatch):
    """A short wait for new workers."""
    monkeypatch.setattr(clusters, "WORKER_LOST_TIMEOUT_S", 1)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    processes = Processes(tmp_path_factory.mktemp("running"))
    processes.scheduler()
    processes.worker("--nworkers", "2")
    yield processes
    processes.end()


@pytest.fixture
def running(shared):
    """A cluster of two workers, shared by the tests; its nannies replace workers that a test kills."""
    wait_for(shared.address, 2)
    return shared


def lost(job, why):
    return (job, why)


def double(job):
    return 2 * job


def hanging(job):
    """Sleep if the job is "sleep"; if it is "hold", do so without a turn for other threads of the process."""
    if job == "sleep":
        time.sleep(600)
    if job == "hold":
        ctypes.PyDLL(None).sleep(600)
    return job


def deadly(job):
    """Kill the worker process if the job is "segfault..." or "exit..."; else return the job."""
    if str(job).startswith("segfault"):
        ctypes.string_at(0)
    if str(job).startswith("exit"):
        os._exit(3)
    time.sleep(0.02)
    return job


def test_map_lazy_jobs_are_taken_as_workers_become_free(running):
    taken, done = [], []

    def jobs():
        for job in range(40):
            taken.append(job)
            yield job

    for result in DaskExecutor(scheduler=running.address).map(double, jobs(), lost):
        done.append(result)
        # Two for each of the two threads, and the next one.
        assert len(taken) <= len(done) + 5
    assert sorted(done) == [2 * job for job in range(40)]


def test_map_many_jobs_cache_of_keys_stays_small(cluster, monkeypatch):
    from dask.utils import key_split

    from flexroad.pipeline.execute import session

    monkeypatch.setattr(session, "FORGET_KEYS_EVERY", 20)
    # The scheduler runs in this process.
    key_split.cache_clear()
    assert len(list(DaskExecutor(scheduler=cluster.scheduler_address).map(double, range(70), lost))) == 70
    assert 0 < key_split.cache_info().currsize < 40


def test_held_executor_has_one_connection_for_several_maps(cluster, monkeypatch):
    opened, connected = [], clusters.connected
    monkeypatch.setattr(clusters, "connected", lambda *given: opened.append(1) or connected(*given))
    with DaskExecutor(scheduler=cluster.scheduler_address).held() as held:
        for numbers in ([1, 2], [], [3]):
            assert sorted(held.map(double, numbers, lost)) == [2 * number for number in numbers]
    assert len(opened) == 1


def threads(job):
    """Return the process id and the numbers of threads, with numpy and torch loaded."""
    import numpy  # noqa: F401
    import torch
    from threadpoolctl import threadpool_info

    time.sleep(0.05)
    pools = [pool["num_threads"] for pool in threadpool_info()]
    return os.getpid(), max(pools), torch.get_num_threads(), os.environ["OMP_NUM_THREADS"]


def test_map_worker_that_joins_later_uses_one_thread(processes):
    many = dict.fromkeys(ONE_THREAD, "2")
    processes.scheduler()
    processes.worker("--preload", "numpy", **many)
    wait_for(processes.address, 1)

    def jobs():
        yield from range(3)
        processes.worker("--preload", "numpy", **many)
        wait_for(processes.address, 2)
        while len({pid for pid, *_ in results}) < 2:
            yield 0

    results = []
    for result in DaskExecutor(scheduler=processes.address).map(threads, jobs(), lost):
        results.append(result)
    assert len({pid for pid, *_ in results}) == 2
    assert {result[1:] for result in results} == {(1, 1, "1")}


def map_error(processes) -> str:
    """Return the one-line message of the ConfigError that `DaskExecutor.map` raises."""
    with pytest.raises(ConfigError) as caught:
        list(DaskExecutor(scheduler=processes.address).map(double, [1, 2, 3], lost))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.usefixtures("impatient")
def test_map_worker_with_other_code_of_the_same_version_is_left_out(processes, tmp_path, monkeypatch):
    monkeypatch.setattr(clusters, "GRACE_S", 0)
    source = tmp_path / "other" / "flexroad"
    shutil.copytree(Path(flexroad.__file__).parent, source, ignore=shutil.ignore_patterns("__pycache__"))
    with (source / "tasks" / "errors.py").open("a") as file:
        file.write("# changed\n")
    processes.scheduler()
    assert f"{processes.address} has no workers; start some" in map_error(processes)
    # Python looks for packages in the working directory first.
    processes.worker(before=("env", "-C", str(source.parent)))
    wait_for(processes.address, 1)
    message = map_error(processes)
    assert (
        f"the code of flexroad is {checksum_of_code(source)} there and {checksum_of_code()} here" in message
    )
    processes.worker()
    wait_for(processes.address, 2)
    lines = []
    executor = DaskExecutor(scheduler=processes.address, notify=lines.append)
    assert sorted(executor.map(double, range(20), lost)) == [*range(0, 40, 2)]
    # The other line is about the scheduler, which is open.
    assert sum(line.startswith("worker tcp://127.0.0.1") for line in lines) == 1


def test_map_scheduler_that_does_not_answer_raises(monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.clusters.ANSWER_S", 1)
    with pytest.raises(ConfigError, match=r"scheduler at tcp://127.0.0.1:9 does not answer"):
        list(DaskExecutor(scheduler="tcp://127.0.0.1:9").map(double, [1], lost))


@pytest.mark.parametrize("poison", [["segfault"], ["exit 1", "segfault 2"]])
def test_map_job_that_kills_its_worker_loses_only_that_job(running, poison):
    """The scheduler's own limit of 7 deaths has no effect."""
    jobs = [*range(10), *poison, *range(10, 20)]
    results = list(DaskExecutor(scheduler=running.address).map(deadly, jobs, lost))
    lost_jobs = [result for result in results if isinstance(result, tuple)]
    assert sorted(job for job, _ in lost_jobs) == poison
    assert all("died 3 times here" in why for _, why in lost_jobs)
    assert sorted(result for result in results if isinstance(result, int)) == list(range(20))


def deadly_for_all(job):
    """Kill all worker processes of the machine's cluster if the job is "kill"; else return the job."""
    if job == "kill":
        # A job on the other worker has started then.
        time.sleep(0.5)
        for process in psutil.Process().parent().children():
            if process.pid != os.getpid() and "spawn_main" in " ".join(process.cmdline()):
                process.kill()
        os._exit(3)
    time.sleep(1)
    return job


def test_job_that_kills_all_workers_each_time_loses_no_other_job(running):
    """As one that takes the machine's memory, so that the system ends other processes, too."""
    jobs = ["kill", *"abcdef"]
    results = list(DaskExecutor(scheduler=running.address).map(deadly_for_all, jobs, lost))
    assert sorted(result for result in results if isinstance(result, str)) == [*"abcdef"]
    ((job, why),) = (result for result in results if isinstance(result, tuple))
    assert job == "kill"
    assert why.startswith("the worker process died 3 times here")


def test_local_workers_share_the_memory_and_may_be_silent(monkeypatch):
    import dask
    from dask.utils import parse_timedelta
    from distributed import Client

    monkeypatch.setattr("flexroad.pipeline.execute.start.MEMORY_LIMIT", 2 * 1024**3)
    with (
        open_cluster(Cluster(workers=2), None, None, False) as target,
        Client(target.target, set_as_default=False) as client,
    ):
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        assert [worker["memory_limit"] for worker in workers] == [1024**3, 1024**3]
        # A worker that dies again and again is started again each time.
        assert parse_timedelta(dask.config.get("distributed.deploy.lost-worker-timeout")) > 1e7
        # A tile may hold the interpreter for as long as it may take.
        assert client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.worker_ttl) == 3900


def greedy(job):
    """Use ever more memory if the job is "greedy"; else do as `deadly`."""
    hoard = []
    while job == "greedy":
        hoard.append(b"x" * 20_000_000)
        time.sleep(0.02)
    return deadly(job)


def test_map_job_above_memory_limit_is_lost_with_reason():
    small = Cluster(workers=1, memory="700 MiB")
    jobs = [1, 2, "greedy", 3, "exit 1", 4]
    results = list(DaskExecutor(cluster=small).map(greedy, jobs, lost))
    reasons = dict(result for result in results if isinstance(result, tuple))
    assert sorted(reasons) == ["exit 1", "greedy"]
    assert "at last for memory: it used" in reasons["greedy"]
    assert "may use 700.00 MiB" in reasons["greedy"]
    assert "at last for memory" not in reasons["exit 1"]
    assert sorted(result for result in results if isinstance(result, int)) == [1, 2, 3, 4]


def test_map_jobs_that_all_exceed_the_memory_end_the_run(monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.session.DEADLY", 3)
    small = Cluster(workers=1, memory="700 MiB")
    said = r"^3 worker processes died .* memory than they may use \(700.00 MiB\), and no tile was done; give"
    with pytest.raises(ConfigError, match=said):
        list(DaskExecutor(cluster=small).map(greedy, ["greedy"] * 9, lost))


def slow(job):
    time.sleep(0.1)
    return job


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("killed", ["scheduler", "workers"])
def test_map_scheduler_or_all_workers_killed_raises(processes, killed):
    scheduler = processes.scheduler()
    worker = processes.worker("--no-nanny")
    wait_for(processes.address, 1)
    results = []

    def map_and_kill():
        for result in DaskExecutor(scheduler=processes.address).map(slow, range(20), lost):
            results.append(result)
            if len(results) == 5:
                (scheduler if killed == "scheduler" else worker).kill()

    with pytest.raises(ClusterLost, match="is gone$" if killed == "scheduler" else "for 1 s"):
        map_and_kill()
    assert results[:5] == [0, 1, 2, 3, 4]
    assert len(results) < 20


def scheduler_state(dask_scheduler) -> list[str]:
    """Names of all tasks and plugins on the scheduler."""
    return [*dask_scheduler.tasks, *dask_scheduler.worker_plugins, *dask_scheduler.plugins]


@pytest.mark.parametrize("wanted", [20, 1], ids=["whole", "interrupted"])
def test_map_ended_leaves_nothing_on_the_cluster(running, wanted):
    from distributed import Client

    with Client(running.address, set_as_default=False) as client:
        before = client.run_on_scheduler(scheduler_state)
        results = DaskExecutor(scheduler=running.address).map(slow, range(20), lost)
        next(results)
        assert len(client.run_on_scheduler(scheduler_state)) > len(before)
        assert len(list(islice(results, wanted - 1))) == wanted - 1
        results.close()
        until(lambda: client.run_on_scheduler(scheduler_state) == before)


def test_slurm_options_write_job_script(tmp_path):
    jobqueue = pytest.importorskip("dask_jobqueue")
    cluster = Cluster(
        kind="slurm", workers=6, per_job=3, memory="2 GiB", walltime_h=2.5, queue="night",
        job_extra=["--exclusive"], prologue=["module load gdal"],
    )  # fmt: skip
    with jobqueue.SLURMCluster(**slurm_options(cluster, False, tmp_path)) as made:
        script = made.job_script()
    lines = script.splitlines()
    assert {
        "#SBATCH -p night", "#SBATCH -n 1", "#SBATCH --cpus-per-task=3",
        "#SBATCH --mem=6G", "#SBATCH -t 02:30:00", "#SBATCH --exclusive", "module load gdal",
        "export OMP_NUM_THREADS=1", "export PYTHONSAFEPATH=1",
        "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False",
        "export DASK_DISTRIBUTED__WORKER__HTTP__ROUTES='[]'",
        f"#SBATCH -e {tmp_path}/flexroad-%J.err",
    } <= set(lines)  # fmt: skip
    assert "--nthreads 1 --memory-limit 2.00GiB --nworkers 3 --nanny" in lines[-1]
    assert "--lifetime 8700s" in lines[-1]


def test_map_on_slurm_starts_and_ends_jobs(tmp_path, monkeypatch):
    """Commands replace SLURM's commands: they start, list and kill local processes."""
    pytest.importorskip("dask_jobqueue")
    jobs = tmp_path / "jobs"
    commands = {
        # The script is copied, as SLURM does: dask-jobqueue removes it at once.
        "sbatch": f'cp "$1" {jobs}.sh; setsid bash {jobs}.sh >/dev/null 2>&1 &\n'
        f"echo $! >>{jobs}; echo Submitted batch job $!",
        "squeue": f"for job in $(cat {jobs}); do kill -0 $job && echo $job; done; true",
        "scancel": 'kill -- -"$1"',
    }
    for name, text in commands.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    # Without a folder for the output there is one at home, which is removed at the end.
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    night = Cluster(kind="slurm", interface="lo", memory="2 GiB", start_s=60)
    assert sorted(DaskExecutor(cluster=night).map(double, range(5), lost)) == [0, 2, 4, 6, 8]
    started = [int(line) for line in jobs.read_text().split()]
    assert len(started) == 1
    until(lambda: not any(psutil.pid_exists(pid) for pid in started))
    assert not list((tmp_path / "home").iterdir())


@pytest.mark.parametrize(
    ("module", "remedy"),
    [("", "there is no sbatch here"), ("dask_jobqueue", r"pip install 'flexroad\[slurm\]'")],
)
def test_open_cluster_missing_program_raises(module, remedy, monkeypatch, tmp_path):
    pytest.importorskip("dask_jobqueue")
    monkeypatch.setenv("PATH", str(tmp_path))
    if module:
        monkeypatch.setitem(sys.modules, module, None)
    cluster = Cluster(kind="slurm", security="none")
    with pytest.raises(ConfigError, match=remedy), open_cluster(cluster, None, None, False):
        pass


def test_fingerprints_do_not_depend_on_cluster(made_survey, tmp_path):
    from flexroad.catalog import Catalog
    from flexroad.pipeline.graph.graph import Pattern

    text = "extends: paper\ncluster: {kind: slurm, queue: night}\n"
    (tmp_path / "night.yaml").write_text(text)
    (tmp_path / "heir.yaml").write_text("extends: night.yaml\ncluster: {workers: 9}\n")
    heir = load_config(tmp_path / "heir.yaml")
    assert (heir.cluster.queue, heir.cluster.workers) == ("night", 9)
    catalog = Catalog.read(made_survey / "catalog.parquet")
    plain, same = (
        [Pattern.of(config).graph(tile).fingerprint for tile in catalog.tiles]
        for config in (load_config("paper"), heir)
    )
    assert same == plain


def test_hanging_jobs_are_stopped_tried_again_and_lost(running):
    limited = Cluster(tile_timeout_s=3)
    jobs = ["a", "sleep", "b", "hold", *map(str, range(20))]
    start = time.monotonic()
    results = list(DaskExecutor(scheduler=running.address, cluster=limited).map(hanging, jobs, lost))
    reason = (
        "it took more than 3 s, 2 times, and was stopped; look at its source files, or raise "
        "cluster.tile_timeout_s"
    )
    assert sorted(result for result in results if isinstance(result, str)) == sorted(
        {*jobs} - {"sleep", "hold"}
    )
    assert sorted(result for result in results if isinstance(result, tuple)) == [
        ("hold", reason), ("sleep", reason),
    ]  # fmt: skip
    assert time.monotonic() - start < 120
