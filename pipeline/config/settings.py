"""Overrides of options in a stage or section, and ``--set fit.spacing_m=5`` by dotted key.

A stage or section that is a single word is its method.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import yaml

from flexroad.catalog.text import printable, shown
from flexroad.pipeline.config import document
from flexroad.pipeline.config.models import TAG
from flexroad.pipeline.errors import ConfigError

Keys = tuple[str, ...]
"""The parts of a dotted key: ``("fit", "spacing_m")``."""


def parsed(text: str) -> tuple[Keys, Any]:
    """Return key and value of ``KEY=VALUE``; the value is YAML within the limits of `document`."""
    key, equals, value = text.partition("=")
    keys = tuple(key.split("."))
    if not equals or not all(keys):
        raise ConfigError(f"--set {shown(text)}: give KEY=VALUE, like --set fit.spacing_m=5")
    return keys, document.parse(value.encode(errors="surrogateescape"), f"--set {printable(key)}")[0]


def _selects_method(keys: Keys) -> bool:
    """Return whether a key selects the method of a stage: its other options depend on the method."""
    stage = keys[2:] if keys[0] == "variants" else keys
    return len(stage) == 1 or (len(stage) == 2 and stage[1] == TAG.get(stage[0]))


def texts(settings: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Return settings as ``KEY=VALUE``, also from a mapping."""
    if isinstance(settings, str):
        return [settings]
    if not isinstance(settings, Mapping):
        return list(settings)
    try:
        return [f"{key}={_flow(value)}" for key, value in settings.items()]
    except yaml.YAMLError as error:
        raise ConfigError(
            f"settings {shown(settings)}: {printable(str(error.args[0]))}; give numbers, texts or lists"
        ) from error


def _flow(value: Any) -> str:
    """Return a value as one line of YAML."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1e9, sort_keys=False)
    return text.removesuffix("...\n").strip()


def applied(raw: Mapping[str, Any], settings: Iterable[tuple[Keys, Any]]) -> dict[str, Any]:
    """Return a configuration with changed options; of equal keys the last value is used.

    Methods are set first: another method starts from its own defaults, in whatever order they are given.
    """
    changed = dict(raw)
    for keys, value in sorted(settings, key=lambda setting: not _selects_method(setting[0])):
        changed = _assigned(changed, keys, value)
    return changed


def _assigned(options: Any, keys: Keys, value: Any, parents: Keys = ()) -> dict[str, Any]:
    """Return the options below ``parents`` with another value at ``keys``."""
    tag = TAG.get(parents[-1]) if parents else None
    where = f"--set {printable('.'.join((*parents, *keys)))}"
    key, *rest = keys
    mapping = tagged(options, tag, f"{where}: {printable('.'.join(parents))}")
    if rest:
        return mapping | {key: _assigned(mapping.get(key), tuple(rest), value, (*parents, key))}
    if key == "variants" and not parents:
        return mapping | {key: value}
    return merge(mapping, {key: value}, tag, where)


def merge(base: Any, override: Any, tag: str | None, where: str) -> dict[str, Any]:
    """Merge an override into options, also into nested options; another method replaces all of them.

    - `base`, `override`: options, or only the name of a method.
    - `tag`: the option that a single word sets, such as ``method``, or None.
    """
    options, changes = tagged(base, tag, where), tagged(override, tag, where)
    if tag in changes and tag in options and changes[tag] != options[tag]:
        return changes
    return options | {key: _merged(options.get(key), key, value, where) for key, value in changes.items()}


def _merged(base: Any, key: str, value: Any, where: str) -> Any:
    """Return the value of one option; missing keys of a mapping or stage are taken from ``base``."""
    if key in TAG or (isinstance(base, dict) and isinstance(value, dict)):
        return merge(base, value, TAG.get(key), where)
    return value


def tagged(options: Any, tag: str | None, where: str) -> dict[str, Any]:
    """Return options as a mapping, even if they are only the name of a method."""
    if options is None:
        return {}
    # YAML reads a bare `off` as false.
    if isinstance(options, str | bool) and tag:
        return {tag: options if isinstance(options, str) else ("on" if options else "off")}
    if isinstance(options, dict):
        return dict(options)
    raise ConfigError(f"{where}: expected a mapping of options, not {shown(options)}")
