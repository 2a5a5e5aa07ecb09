"""The workers' options of a run, for a command that uses them again: who gave them, and other values."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import replace

from flexroad.catalog.text import printable
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.config.settings import Setting, applied
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run

SECTION = "cluster"


def with_workers(run: Run, settings: Sequence[str]) -> Run:
    """Return a run with options of its workers replaced for one command.

    Those of RUN/config.yaml that can start programs (`Cluster.programs`) count only if they are sealed: the
    run may come from anyone.

    Parameters
    ----------
    run : Run
    settings : sequence of str
        Options of the command line: ``cluster.workers=8``.

    Raises
    ------
    ConfigError
        If a setting is not of the workers or is invalid, or an option that can start programs is neither
        sealed nor among the settings.
    """
    parsed = [Setting.parse(text) for text in settings]
    for setting in parsed:
        if setting.keys[0] != SECTION:
            raise ConfigError(
                f"--set {printable('.'.join(setting.keys))}: rerun takes options of {SECTION} only, like "
                f"--set {SECTION}.workers=8; change others with `flexroad run`"
            )
    config = run.config
    if parsed:
        config = compose(applied(config.raw, parsed), config.name)
    given = {name for setting in parsed for name in setting.keys[1:2]}
    whole = any(len(setting.keys) == 1 for setting in parsed)
    unsealed = {name: value for name, value in config.cluster.programs.items() if name not in given}
    if unsealed and not whole and not run.programs_sealed:
        again = (f"--set {shlex.quote(f'{SECTION}.{n}={json.dumps(v)}')}" for n, v in unsealed.items())
        raise ConfigError(
            f"{run.path / 'config.yaml'}: {SECTION}.{next(iter(unsealed))} can start programs, and this user "
            f"has not given it on this machine; if it is right, add {' '.join(again)}"
        )
    return replace(run, config=config)
