"""One run at a time in a run folder: a lock that names its holder, and that nobody keeps who is dead.

``RUN/lock.json`` says who holds it. Of a holder on this machine the process table tells whether it lives,
whatever the clocks say; of one elsewhere the file's own time, which it renews every half minute, compared by
the storage's clock. Before such a lock is taken over it is watched for a while, so that a clock that jumped
does no harm, either.
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
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from flexroad.catalog.storage.paths import Location, read
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.lock_file import LockFile, LockStat, OnDisk

NAME = "lock.json"
TRIES = 20


@dataclass(frozen=True)
class Heartbeat:
    """How often a holder gives a sign of life, and when others miss it."""

    beat_s: float = 30
    stale_s: float = 300


@dataclass(frozen=True)
class Owner:
    """A process that may hold a lock."""

    host: str
    machine: str
    """Tells machines of one name apart, and containers that count processes for themselves."""
    boot: str
    pid: int
    start: int
    """When the process started, in ticks since the machine did; 0 where that cannot be told."""
    since: str
    token: str

    @classmethod
    def me(cls) -> Owner:
        """Return this process."""
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
        """Return who wrote a lock, or None if it is damaged or half-written."""
        try:
            return cls(**json.loads(data))
        except (ValueError, TypeError):
            return None

    @property
    def data(self) -> bytes:
        """The content of the lock."""
        return json.dumps(asdict(self), indent=1).encode()

    def gone(self, here: Owner, started: Callable[[int], int | None]) -> str | None:
        """Tell why this holder, on the machine of ``here``, no longer lives; None if it does."""
        if self.boot != here.boot:
            return f"{self.host} was restarted since"
        start = started(self.pid)
        if start is None:
            return "that process is gone"
        if start and self.start and start != self.start:
            return "that process is gone, its number was given to another"
        return None


def death_of(who: Owner) -> str | None:
    """Tell why a holder is known to be dead: a process of this machine that is gone; None if it may live."""
    here = Owner.me()
    return who.gone(here, started) if (who.host, who.machine) == (here.host, here.machine) else None


def at_work(who: Owner) -> str:
    """Return a line about who holds a run's lock."""
    why = death_of(who)
    name = f"pid {who.pid} on {who.host}"
    return f"{name} ended in the middle ({why})" if why else f"{name} at work since {who.since}"


@contextlib.contextmanager
def run_lock(
    run: Location, say: Callable[[str], None] = lambda line: None, pace: Heartbeat | None = None
) -> Iterator[None]:
    """Hold a run folder's lock.

    Parameters
    ----------
    run : Place
        The folder, which must be there if it is on disk.
    say : callable
        Told, in one line, of a dead holder's lock taken over.

    Raises
    ------
    ConfigError
        If another process holds it, or nothing can be written there.
    """
    lock = _Lock(run, _file(run / NAME), Owner.me(), say, pace or Heartbeat())
    try:
        lock.take()
    except FileNotFoundError as error:
        raise ConfigError(f"{run} is no run; make one with `flexroad run --out {run}`") from error
    except OSError as error:
        raise ConfigError(
            f"cannot write the run to {run}: {error}; mend that or choose another --out"
        ) from error
    over = threading.Event()
    beating = threading.Thread(target=lock.beat, args=(over,), name="lock", daemon=True)
    beating.start()
    try:
        yield
    finally:
        over.set()
        beating.join()
        lock.release()


def owner(run: Location) -> Owner | None:
    """Return who holds a run's lock, dead or alive, or None if nobody does; takes and writes nothing."""
    try:
        return Owner.of(read(run / NAME))
    except OSError:
        return None


def started(pid: int) -> int | None:
    """Return when a process of this machine started, 0 if that cannot be told, None if there is none.

    In ticks since the machine's start, which no setting of the clock changes.
    """
    try:
        told = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return _hidden(pid)
    # A dead process that nobody buried is dead.
    return None if told[0] in "ZX" else int(told[19])


def _hidden(pid: int) -> int | None:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        return 0
    return 0


@dataclass(frozen=True)
class _Lock:
    run: Location
    file: LockFile
    me: Owner
    say: Callable[[str], None]
    pace: Heartbeat

    def take(self) -> None:
        """Become the holder; of several that try at once, one does."""
        for _ in range(TRIES):
            if self.file.create(self.me.data):
                return
            seen = self.file.look()
            if seen is None:
                continue
            if seen.data == self.me.data:
                # The bucket's answer was lost, and what was asked again was refused.
                return
            who = Owner.of(seen.data)
            why = self._dead(who, seen)
            if why and self.file.replace(seen, self.me.data):
                self.say(f"took over the lock of {_name(who)}: {why}")
                return
            if not why and (who is not None or seen.data):
                raise ConfigError(self._refusal(who, seen))
            # Somebody is just writing it, or was faster: look again.
            time.sleep(0.05)
        raise ConfigError(f"{self.run / NAME} cannot be read; if no run goes on there, remove it")

    def beat(self, over: threading.Event) -> None:
        """Give signs of life until it is over; a lock that another has by now ends this process's run."""
        while not over.wait(self.pace.beat_s):
            # A storage out of reach for a while is no reason to stop.
            with contextlib.suppress(OSError):
                seen = self.file.look()
                if seen is None:
                    self.file.create(self.me.data)
                elif seen.data == self.me.data:
                    self.file.beat(seen)
                else:
                    self.say(f"{_name(Owner.of(seen.data))} took over the lock of {self.run}: this run ends")
                    # Not the signal of Ctrl-C, to which background jobs are deaf.
                    os.kill(os.getpid(), signal.SIGTERM)
                    return

    def release(self) -> None:
        """Give it back, if it is still ours."""
        with contextlib.suppress(OSError):
            seen = self.file.look()
            if seen is not None and seen.data == self.me.data:
                self.file.remove(seen)

    def _dead(self, who: Owner | None, seen: LockStat) -> str | None:
        """Tell why a lock's holder counts as dead; None if it may live."""
        if who is not None and (who.host, who.machine) == (self.me.host, self.me.machine):
            return death_of(who)
        if abs(seen.age_s) <= self.pace.stale_s:
            return None
        watch_s = 1.5 * self.pace.beat_s
        self.say(f"watching the lock of {_name(who)} for {watch_s:.0f} s, to see whether it lives")
        time.sleep(watch_s)
        again = self.file.look()
        if again is None or again.written != seen.written:
            return None
        return f"no sign of life for {watch_s if seen.age_s < 0 else seen.age_s:.0f} s"

    def _refusal(self, who: Owner | None, seen: LockStat) -> str:
        text = f"{self.run} is in use by {_name(who)}{f' since {who.since}' if who else ''}"
        if who is not None and (who.host, who.machine) == (self.me.host, self.me.machine):
            return f"{text}; wait for it, or end it with `kill {who.pid}`"
        # From here only its signs of life can be seen.
        return (
            f"{text}, last sign of life {abs(seen.age_s):.0f} s ago; "
            f"if it is dead, the same command takes over {self.pace.stale_s:.0f} s after the last one"
        )


def _file(path: Location) -> LockFile:
    if isinstance(path, Path):
        return OnDisk(path)
    from flexroad.pipeline.run.lock_object import InBucket

    return InBucket(path)


def _name(who: Owner | None) -> str:
    return f"pid {who.pid} on {who.host}" if who else "somebody unknown (it is damaged)"


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _namespace() -> str:
    try:
        return str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        return ""
