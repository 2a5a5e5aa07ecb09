"""Merge the options of a stage or section; a single word is its method."""

from __future__ import annotations

from typing import Any

from flexroad.catalog.text import shown
from flexroad.pipeline.errors import ConfigError


def merge(base: Any, override: Any, tag: str | None, where: str) -> dict[str, Any]:
    """Merge an override into a stage's options; an override with another method replaces them.

    Parameters
    ----------
    base, override : dict, str, bool or None
        Options, or the method alone.
    tag : str or None
        The option that a single word sets, such as ``method``; None if there is none.
    where : str
        The place in the configuration, for messages.

    Raises
    ------
    ConfigError
        If one of them is neither.
    """
    options, changes = tagged(base, tag, where), tagged(override, tag, where)
    if tag in changes and tag in options and changes[tag] != options[tag]:
        return changes
    return options | changes


def tagged(options: Any, tag: str | None, where: str) -> dict[str, Any]:
    """Return options as a mapping, also if they are only the name of a method.

    Raises
    ------
    ConfigError
        If they are neither.
    """
    if options is None:
        return {}
    # YAML reads a bare `off` as false.
    if isinstance(options, str | bool) and tag:
        return {tag: options if isinstance(options, str) else ("on" if options else "off")}
    if isinstance(options, dict):
        return dict(options)
    raise ConfigError(f"{where}: expected a mapping of options, not {shown(options)}")
