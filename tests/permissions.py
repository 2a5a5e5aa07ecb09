"""File permissions for tests that run as root."""

import contextlib
import ctypes
from collections.abc import Iterator


@contextlib.contextmanager
def permissions_enforced() -> Iterator[None]:
    """Enforce file permissions in this thread, also for root, by dropping capabilities."""
    libc = ctypes.CDLL(None, use_errno=True)
    header, before = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, before) == 0
    fewer = (ctypes.c_uint32 * 6)(*before)
    # The effective bits of CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH.
    fewer[0] &= ~0b110
    assert libc.capset(header, fewer) == 0
    try:
        yield
    finally:
        assert libc.capset(header, before) == 0
