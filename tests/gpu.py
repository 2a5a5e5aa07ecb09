"""Skip tests on machines without a GPU."""

import pytest

REASON = "needs a GPU"


def needs_gpu():
    """Skip the calling test unless PyTorch finds a GPU."""
    if not pytest.importorskip("torch").cuda.is_available():
        pytest.skip(REASON)
