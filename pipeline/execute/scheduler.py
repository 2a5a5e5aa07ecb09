"""Objects sent to the scheduler.

They are pickled by value, so that the scheduler needs no flexroad.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import SchedulerPlugin


def task_function() -> Callable[[bytes, str, bool], tuple[str, str, str, Any, Any]]:
    """Return the function of every task: it unpickles a call and runs it if the worker passed its check.

    Its arguments are the pickled call, the name of the `WorkerCheck` and whether the client has accepted the
    worker. It returns address and host of the worker, what `WorkerCheck.admit` returns, and the result, None
    if the call did not run. A scheduler unpickles the tasks that it receives; a call that is already pickled
    stays bytes there.
    """

    def run_task(packed: bytes, check: str, accepted: bool) -> tuple[str, str, str, Any, Any]:
        import socket

        from distributed import get_worker
        from distributed.protocol.pickle import loads

        worker = get_worker()
        address, host = worker.address, socket.gethostname()
        admit = getattr(worker.plugins.get(check), "admit", None)
        if admit is None:
            # An older version may have another `WorkerCheck`.
            return address, host, "it cannot load this version of flexroad; install it there", None, None
        fault, proof = admit(packed, accepted)
        if fault or proof is not None:
            return address, host, fault, proof, None
        work, function, job = loads(packed)
        return address, host, "", None, work(function, job)

    return run_task


def retry_blocker(client_id: str, check: str) -> SchedulerPlugin:
    """Return a scheduler plugin that fails a client's tasks at the first death of their worker.

    By default a scheduler retries such tasks on other workers (setting
    ``distributed.scheduler.allowed-failures``), so that a tile that kills its worker would kill others, too.
    Tasks of other clients are not affected. When the client disconnects or is killed, the plugins are
    removed.
    """

    class RetryBlocker(SchedulerPlugin):  # type: ignore[misc]
        def update_graph(self, scheduler: Any, *, client: str, tasks: list[Any], **_: Any) -> None:
            if client == client_id:
                for key in tasks:
                    # With this count one more death of a worker fails the task.
                    scheduler.tasks[key].suspicious = scheduler.allowed_failures

        def remove_client(self, scheduler: Any, client: str) -> None:
            if client == client_id:
                scheduler.worker_plugins.pop(check, None)
                scheduler.plugins.pop(f"flexroad-{check}", None)

    return RetryBlocker()
