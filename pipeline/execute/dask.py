"""Many jobs at once, on Dask: connect, check that the workers are fit, and submit."""

from __future__ import annotations

import contextlib
import logging
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import chain, islice
from typing import TYPE_CHECKING, Any

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute.clusters import ClusterTarget, open_cluster
from flexroad.pipeline.execute.executor import J, R

if TYPE_CHECKING:
    from distributed import Client

LOCAL = Cluster()
ANSWER_S = 10.0
"""How long a scheduler may take to answer."""


class DaskExecutor:
    """Local worker processes of one thread each, a running cluster, or one that is asked for.

    Parameters
    ----------
    workers : int, optional
        Number of processes; by default what ``cluster`` says.
    scheduler : str, optional
        Address of a running Dask scheduler, used instead.
    cluster : Cluster
        Who works, and how long is waited for them.
    dashboard : bool
        Serve Dask's dashboard; where it is goes to ``say``.
    say : callable
        Told in one line what whoever watches wants to know: the dashboard, who is waited for.
    """

    def __init__(
        self,
        workers: int | None = None,
        scheduler: str | None = None,
        cluster: Cluster = LOCAL,
        dashboard: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.workers = workers
        self.scheduler = scheduler
        self.cluster = cluster
        self.dashboard = dashboard
        self.say = say

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
    ) -> Generator[R, None, None]:
        """Yield results as tiles finish."""
        queue = iter(jobs)
        first = list(islice(queue, 1))
        if not first:
            # Nothing to do needs no workers.
            return
        from flexroad.pipeline.execute.session import Session

        with (
            _quiet(),
            open_cluster(self.cluster, self.workers, self.scheduler, self.dashboard) as place,
            self._connected(place) as client,
        ):
            guard = _guard(client, place, probe)
            session = Session(
                client,
                place.name,
                guard,
                function,
                chain(first, queue),
                lost,
                self.cluster.patience_s,
                self.say,
            )
            yield from session.results()

    @contextlib.contextmanager
    def _connected(self, place: ClusterTarget) -> Iterator[Client]:
        from distributed import Client

        try:
            client = Client(place.target, timeout=ANSWER_S, set_as_default=False)
        except OSError as error:
            raise ConfigError(f"{place.name} does not answer: {error}") from error
        with client:
            if self.dashboard:
                self.say(_dashboard(client))
            if not _any_worker(client, time.monotonic() + place.start_s):
                raise ConfigError(
                    f"{place.name} has no workers; start some (`dask worker ADDRESS --nthreads 1`)"
                )
            yield client


def _any_worker(client: Client, end: float) -> bool:
    with contextlib.suppress(OSError):
        while not client.nthreads():
            if time.monotonic() > end:
                return False
            time.sleep(0.2)
        return True
    return False


def _guard(client: Client, place: ClusterTarget, probe: Callable[[], None] | None) -> str:
    """Compare versions, put plugins on scheduler and workers, and probe; return the guard's name.

    Raises
    ------
    ConfigError
        If a worker is not fit for the work.
    ClusterLost
        If nobody answers any more.
    """
    from flexroad.pipeline.execute import workers
    from flexroad.pipeline.execute.scheduler import no_second_try

    here = workers.versions()
    name = uuid.uuid4().hex[:8]
    try:
        _compare(client, here)
        client.register_plugin(no_second_try(client.id, name), name=f"flexroad-{name}")
        _post(client, workers.WorkerCheck(here, probe, ignore_sigint=place.own), name)
    except ConfigError:
        raise
    except OSError as error:
        raise ClusterLost(f"{place.name} went away before its first tile: {error}") from error
    except Exception as error:
        # Of whatever kind unpickling gave; only a line of it helps.
        told = " ".join(str(error).split()) or repr(error)
        raise ConfigError(
            f"{place.name} cannot load flexroad ({told}); install it for the workers, and let the scheduler "
            "take plugins (distributed.scheduler.pickle)"
        ) from error
    # A worker that dies meanwhile is no fault; the one after it is asked when its first tile comes.
    for fault in client.run(workers.find_fault, name, on_error="ignore").values():
        if fault:
            raise ConfigError(fault)
    return name


def _post(client: Client, guard: Any, name: str) -> None:
    """Put a guard on all workers, again if one of them just died."""
    for rest in range(4, -1, -1):
        try:
            client.register_plugin(guard, name=name)
            return
        except OSError:
            if not rest:
                raise
            time.sleep(1)


def _compare(client: Client, here: dict[str, str]) -> None:
    """Compare versions by Dask's own message: what differs too much could not load anything of ours."""
    from flexroad.pipeline.execute.workers import PICKLING

    found = client.get_versions(packages=[name for name in here if name != "python"])
    _refuse("the scheduler", found["scheduler"], {name: here[name] for name in PICKLING})
    for address, worker in found["workers"].items():
        _refuse(f"worker {address}", worker, here)


def _refuse(who: str, found: Any, here: dict[str, str]) -> None:
    from flexroad.pipeline.execute.workers import difference, unlike

    there = {name: found["packages"].get(name) or "missing" for name in here}
    there["python"] = ".".join(found["host"]["python"].split(".")[:3])
    other = difference(there, here)
    if other:
        raise ConfigError(unlike(who, other))


def _dashboard(client: Client) -> str:
    try:
        import bokeh  # noqa: F401
    except ImportError:
        return "no dashboard: it needs bokeh (pip install 'flexroad[dashboard]')"
    return f"dashboard: {client.dashboard_link}"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's own words about what is told in one's own: lost workers, schedulers, versions."""
    from distributed.utils import silence_logging_cmgr

    with silence_logging_cmgr(logging.CRITICAL), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        yield
