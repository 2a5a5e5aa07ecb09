"""The line ``next: ...`` that commands print when they have written a catalog."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from flexroad.catalog import Catalog
from flexroad.catalog.allowlist import needed
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.layers import fitting_config
from flexroad.pipeline.run.record import check_inputs


def after_catalog(path: Path, config: str | None = None, changes: Sequence[str] = ()) -> str:
    """Return the command that runs a catalog, ready to be pasted, or what a run lacks.

    - `path`: the catalog's file.
    - `config`: the configuration; default: the one for production that fits the catalog's layers.
    - `changes`: values of ``--set``.
    """
    catalog = Catalog.read(path)
    name = config or fitting_config(catalog)
    settings = load_config(name, changes)
    try:
        check_inputs(settings, catalog)
    except ConfigError as error:
        return f"before a run: {error}"
    # Many catalogs are called catalog.parquet: their folder tells them apart.
    title = path.stem if path.stem != "catalog" else path.absolute().parent.name or "run"
    words = ["flexroad", "run", "--config", name, *(word for change in changes for word in ("--set", change))]
    words += ["--catalog", str(path), "--out", f"runs/{title}"]
    # Of all layers, so that the same options suit `catalog check` and `train`.
    for folder in needed(catalog, path.parent):
        words += ["--allow", folder]
    return f"next: {shlex.join(words)}"
