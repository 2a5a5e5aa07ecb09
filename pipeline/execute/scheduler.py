"""Objects sent to the scheduler.

They are pickled by value, so that the scheduler needs no flexroad.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import SchedulerPlugin


def task_function() -> Callable[[bytes, str], tuple[str, Any]]:
    """Return the function of every task: it unpickles a call and runs it if the worker passed its check.

    Its arguments are the pickled call and the name of the `WorkerCheck`; it returns an error message, empty
    if there is none, and the result. A scheduler unpickles the tasks that it receives; a call that is
    already pickled stays bytes there.
    """

    def run_task(packed: bytes, check: str) -> tuple[str, Any]:
        from distributed import get_worker
        from distributed.protocol.pickle import loads

        worker = get_worker()
        if check not in worker.plugins:
            return f"worker {worker.address} cannot load flexroad; install it there", None
        fault: str = worker.plugins[check].fault
        if fault:
            return fault, None
        work, function, job = loads(packed)
        return "", work(function, job)

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
