"""The lock of a run folder: one process at a time may write a run; the lock of a dead process is taken over.

``RUN/lock.json`` names the owner: host, process id and start time. If the owner is on this machine, the
process table shows whether it is alive, independent of any clock. An owner on another machine renews the
file's time every 30 s; the age of the file is measured with the storage's clock. Before such a lock is taken
over, it is observed for a while: a clock that jumped cannot make a living owner lose it.

Machines made from one image may have the same name and machine id, but never the same boot id. So an owner
with another boot id ran before the last restart of this machine, or runs on another machine. It is on another
machine if it has renewed its lock since this machine was started.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from flexroad.catalog.storage.paths import Location, read
from flexroad.catalog.text import Notify
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.lock_file import InBucket, LockStat, OnDisk, lock_file

NAME = "lock.json"
TRIES = 20
"""Attempts to take a lock that changes or is just being written."""


@dataclass(frozen=True)
class Owner:
    """The process that holds a lock, as written to lock.json."""

    host: str
    machine: str
    """Machine id and process namespace: distinguishes machines of the same name, and containers."""
    boot: str
    """Boot id of the machine, new after each restart."""
    pid: int
    start: int
    """Start time of the process in clock ticks since boot; 0 if unknown."""
    since: str
    """Time at which the lock was requested, ISO 8601 in UTC."""
    token: str
    """Random hexadecimal text, unique to this lock."""

    @classmethod
    def me(cls) -> Owner:
        """Return this process as an owner."""
        return cls(
            host=socket.gethostname(),
            machine=f"{_read('/etc/machine-id')} {_namespace()}".strip(),
            boot=_read("/proc/sys/kernel/random/boot_id"),
            pid=os.getpid(),
            start=started(os.getpid()) or 0,
            since=datetime.now(UTC).isoformat(timespec="seconds"),
            token=secrets.token_hex(8),
        )

    @classmethod
    def of(cls, data: bytes) -> Owner | None:
        """Return the owner in the content of a lock file, None if it is damaged or incomplete."""
        try:
            return cls(**json.loads(data))
        except (ValueError, TypeError):
            return None

    @property
    def data(self) -> bytes:
        """The content of the lock file."""
        return json.dumps(asdict(self), indent=1).encode()


def exit_reason(holder: Owner) -> str | None:
    """Return why an owner is dead, if it is a process of this machine that has exited; else None."""
    here = Owner.me()
    if (holder.host, holder.machine) != (here.host, here.machine):
        return None
    if holder.boot != here.boot:
        return f"{holder.host} was restarted since"
    start = started(holder.pid)
    if start is None:
        return "that process is gone"
    if start and holder.start and start != holder.start:
        return "that process is gone, its number was given to another"
    return None


def describe_owner(holder: Owner) -> str:
    """Return one line about the owner of a run's lock: its process, and its start time or why it ended."""
    reason = exit_reason(holder)
    name = f"pid {holder.pid} on {holder.host}"
    if reason:
        return f"{name} ended before the run was complete ({reason})"
    return f"{name} at work since {holder.since}"


@contextlib.contextmanager
def run_lock(
    run: Location, notify: Notify = lambda line: None, interval_s: float = 30, stale_s: float = 300
) -> Iterator[None]:
    """Hold the lock of a run folder; a context manager.

    - `run`: the run folder; on disk it must exist.
    - `notify`: receives one line when the lock of a dead process is observed or taken over, or this lock is
      lost.
    - `interval_s`: interval at which the owner renews its lock (s).
    - `stale_s`: age at which an owner on another machine is taken as dead (s).
    """
    lock = _Lock(run, lock_file(run / NAME), Owner.me(), notify, interval_s, stale_s)
    try:
        lock.take()
    except FileNotFoundError as error:
        raise ConfigError(f"{run} is no run; make one with `flexroad run --out {run}`") from error
    except OSError as error:
        raise ConfigError(
            f"cannot write the run to {run}: {error}; correct that or choose another --out"
        ) from error
    stop = threading.Event()
    renewal = threading.Thread(target=lock.renew_until, args=(stop,), name="lock", daemon=True)
    renewal.start()
    try:
        yield
    finally:
        stop.set()
        renewal.join()
        lock.release()


def owner(run: Location) -> Owner | None:
    """Return the owner of a run's lock, dead or alive, None if it is free; does not change the lock."""
    try:
        return Owner.of(read(run / NAME))
    except OSError:
        return None


def started(pid: int) -> int | None:
    """Return the start time of a process of this machine, 0 if it is unknown, None if it has exited.

    The time is in clock ticks since boot, so that setting the clock does not change it.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return _start_without_proc(pid)
    # Z (zombie) and X (dead): the process has exited, but its parent has not waited for it.
    return None if fields[0] in "ZX" else int(fields[19])


def _start_without_proc(pid: int) -> int | None:
    """Return 0 if a process exists whose start time cannot be read, None if it does not exist."""
    with contextlib.suppress(PermissionError):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return None
    return 0


@dataclass(frozen=True)
class _Lock:
    run: Location
    file: OnDisk | InBucket
    me: Owner
    notify: Notify
    interval_s: float
    stale_s: float

    def take(self) -> None:
        """Become the owner; if several processes try at the same time, exactly one succeeds."""
        for _ in range(TRIES):
            if self.file.create(self.me.data):
                return
            current = self.file.read()
            if current is None:
                continue
            if current.data == self.me.data:
                # The bucket's first response was lost, and the repeated request was rejected.
                return
            holder = Owner.of(current.data)
            reason = self._dead(holder, current)
            if reason and self.file.replace(current, self.me.data):
                self.notify(f"took over the lock of {_name(holder)}: {reason}")
                return
            if not reason and (holder is not None or current.data):
                raise ConfigError(self._refusal(holder, current))
            # Another process is writing the file or has just replaced it: read it again.
            time.sleep(0.05)
        raise ConfigError(f"{self.run / NAME} cannot be read; if no run is active there, remove it")

    def renew_until(self, stop: threading.Event) -> None:
        """Renew the lock until ``stop`` is set; if another process has taken it over, end this process."""
        while not stop.wait(self.interval_s):
            # The run goes on if the storage is temporarily out of reach.
            with contextlib.suppress(OSError):
                current = self.file.read()
                if current is None:
                    self.file.create(self.me.data)
                elif current.data == self.me.data:
                    self.file.renew(current)
                else:
                    name = _name(Owner.of(current.data))
                    self.notify(f"{name} took over the lock of {self.run}: this run ends")
                    # SIGTERM, because background jobs of a shell ignore SIGINT.
                    os.kill(os.getpid(), signal.SIGTERM)
                    return

    def release(self) -> None:
        """Remove the lock if this process still owns it."""
        with contextlib.suppress(OSError):
            current = self.file.read()
            if current is not None and current.data == self.me.data:
                self.file.remove(current)

    def _dead(self, holder: Owner | None, current: LockStat) -> str | None:
        """Return why the owner is taken as dead, None if it may be alive."""
        watch_s = 1.5 * self.interval_s
        # Just after a start this is not known, because an owner renews its lock only at intervals.
        before_start = current.age_s > max(watch_s, _uptime_s())
        if holder is not None and (holder.boot == self.me.boot or before_start):
            reason = exit_reason(holder)
            if reason or self._is_here(holder):
                return reason
        if abs(current.age_s) <= self.stale_s:
            return None
        self.notify(f"watching the lock of {_name(holder)} for {watch_s:.0f} s, to see whether it is renewed")
        time.sleep(watch_s)
        later = self.file.read()
        if later is None or later.written != current.written:
            return None
        return f"no sign of life for {watch_s if current.age_s < 0 else current.age_s:.0f} s"

    def _is_here(self, holder: Owner) -> bool:
        """Return whether the owner is a process of this machine since its last start."""
        here = self.me.host, self.me.machine, self.me.boot
        return (holder.host, holder.machine, holder.boot) == here

    def _refusal(self, holder: Owner | None, current: LockStat) -> str:
        """Return the error message for a lock that another process holds."""
        text = f"{self.run} is in use by {_name(holder)}{f' since {holder.since}' if holder else ''}"
        if holder is not None and self._is_here(holder):
            return f"{text}; wait for it, or end it with `kill {holder.pid}`"
        # A process on another machine can be judged only by the age of its lock.
        return (
            f"{text}, last sign of life {abs(current.age_s):.0f} s ago; "
            f"if it is dead, the same command takes over {self.stale_s:.0f} s after the last one"
        )


def _name(holder: Owner | None) -> str:
    return f"pid {holder.pid} on {holder.host}" if holder else f"an unknown process ({NAME} is damaged)"


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _uptime_s() -> float:
    """Return the time since the start of this machine (s), infinity if it is unknown."""
    return float((_read("/proc/uptime") or "inf").split()[0])


def _namespace() -> str:
    """Return the process namespace, which differs between containers; ``""`` if it is unknown."""
    try:
        return str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        return ""
