"""Signals: an interrupt that a callback loses comes again, and a second signal ends every command."""

import contextlib
import logging
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable

import numpy as np
import pytest
import rasterio

from flexroad.pipeline.cli.signals import ENDED, NUMBERS, ONE_S, signals_interrupt
from tests.command_line import same_signals
from tests.make_rasters import damage, write

WAIT_S = 20
"""Longest wait for a signal (s); without it the tests would not end."""


@pytest.fixture
def damaged(tmp_path):
    """A raster with a block that cannot be decoded: GDAL logs each read."""
    path = write(
        tmp_path / "damaged.tif", np.random.default_rng(1).normal(size=(200, 200)), compress="deflate"
    )
    damage(path, 100, 100)
    return path


def interrupt(*_):
    signal.raise_signal(signal.SIGINT)
    return True


def raised(block: Callable[[], object]) -> bool:
    """Whether a block is interrupted."""
    try:
        with same_signals(), signals_interrupt():
            block()
    except KeyboardInterrupt:
        return True
    return False


def test_interrupt_while_gdal_logs_a_read_is_not_lost(damaged, caplog, capfd):
    log, reads = logging.getLogger("rasterio._err"), 0

    def read():
        nonlocal reads
        for _ in range(1000):
            try:
                with rasterio.open(damaged) as opened:
                    opened.read(1)
            except rasterio.RasterioIOError:
                reads += 1

    log.addFilter(interrupt)
    try:
        with caplog.at_level(logging.INFO, log.name):
            assert raised(read)
    finally:
        log.removeFilter(interrupt)
    assert reads < 1000
    assert "IReadBlock failed" in caplog.text
    assert capfd.readouterr().err == ""


def test_interrupt_that_a_library_ignores_is_raised_again():
    def ignore():
        with contextlib.suppress(BaseException):
            interrupt()
        time.sleep(WAIT_S)

    assert raised(ignore)


@pytest.mark.parametrize("number", NUMBERS)
def test_interrupt_is_raised_once_while_the_block_ends(number):
    ended = []

    def end():
        try:
            signal.raise_signal(number)
        finally:
            time.sleep(0.3)
            try:
                raise OSError
            except OSError:
                time.sleep(0.3)
            ended.append(number)

    assert raised(end)
    assert ended == [number]


def test_interrupt_taken_up_inside_comes_no_more():
    def block():
        assert raised(interrupt)
        time.sleep(0.3)

    assert not raised(block)


def test_without_signal_handlers_are_as_before():
    before = [signal.getsignal(number) for number in (*NUMBERS, signal.SIGALRM)]
    hooks, wakeup = (sys.unraisablehook, sys.excepthook), signal.set_wakeup_fd(-1)
    with signals_interrupt():
        pass
    assert [signal.getsignal(number) for number in (*NUMBERS, signal.SIGALRM)] == before
    assert (sys.unraisablehook, sys.excepthook) == hooks
    assert signal.set_wakeup_fd(wakeup) == -1


def test_signal_that_is_ignored_stays_ignored_after_an_interruption():
    with same_signals():
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with pytest.raises(KeyboardInterrupt), signals_interrupt():
            interrupt()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


IN_LIBRARY = """
    import ctypes
    from flexroad.pipeline.cli.signals import signals_interrupt
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)
    with signals_interrupt():
        libc.pthread_mutex_lock(mutex)
        print("ready", flush=True)
        libc.pthread_mutex_lock(mutex)  # waits for ever, and no signal ends the wait
"""
AT_THE_END = """
    import signal, time
    from flexroad.pipeline.cli.signals import signals_interrupt
    try:
        with signals_interrupt():
            signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        print("ready", flush=True)
        time.sleep(60)
"""


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("code", [IN_LIBRARY, AT_THE_END], ids=["in a C library", "at the end"])
def test_second_signal_ends_the_process(code, number):
    words = [sys.executable, "-c", textwrap.dedent(code)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        # The line is printed before the library is called.
        time.sleep(0.5)
        process.send_signal(number)
        time.sleep(ONE_S + 0.3)
        process.send_signal(number)
        try:
            _, said = process.communicate(timeout=WAIT_S)
        finally:
            process.kill()
    assert (process.returncode, said) == (128 + number, ENDED)


COMMANDS = {
    "status": ("run",),
    "view": ("run",),
    "export": ("run", "--format", "obj", "-o", "out"),
    "run": ("--catalog", "c.parquet", "--out", "run"),
}
"""Commands of which each handles an interrupt in a place of its own; the others are as `status`."""
SENT = """
    import os, time
    from flexroad.catalog import Catalog
    from flexroad.pipeline.cli.main import main
    from flexroad.pipeline.run.record import Run

    def sent(*_, **__):
        os.kill(os.getpid(), {number})
        time.sleep(60)

    Catalog.read = Run.open = sent
    main()
"""


@pytest.mark.parametrize(
    ("command", "number"),
    [*((name, signal.SIGHUP) for name in COMMANDS), ("status", signal.SIGTERM), ("view", signal.SIGTERM)],
)
def test_interrupted_command_says_so_in_one_line_with_exit_code_130(tmp_path, command, number):
    words = [sys.executable, "-c", textwrap.dedent(SENT.format(number=int(number))), command]
    done = subprocess.run(
        [*words, *COMMANDS[command]], cwd=tmp_path, capture_output=True, text=True, timeout=WAIT_S * 3
    )
    goes_on = "the same command goes on from here" if command in ("export", "run") else "repeat the command"
    assert (done.returncode, done.stderr.strip()) == (130, f"interrupted; {goes_on}")
