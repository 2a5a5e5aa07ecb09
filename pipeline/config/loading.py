"""Read a configuration from YAML, resolve `extends`, and validate it; one line per error."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.methods import DEFAULTS
from flexroad.pipeline.config.models import TAG, Config, Export, stage_models
from flexroad.pipeline.errors import ConfigError

SPLINE = "; the solver is a method of its own: fit: {method: smoothing_spline}"
RENAMED = {
    "variant": "; it is called method",
    "grounded": "; it is called planar",
    "hygiene": "; it is called cleanup",
    "doubt_m": "; it is called error_estimate_m",
    "doubted_m2": "; it is called suspect_m2",
    "solver": SPLINE,
    "smoothness": SPLINE,
}
"""Option names of earlier versions and the hint for each."""


def shipped() -> dict[str, Path]:
    """Return the configurations that come with the program, by name."""
    # In a checkout the package's folders are links; resolve() leads to the root, which has configs/.
    folder = Path(__file__).resolve().parents[2] / "configs"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_config(name: str | Path) -> Config:
    """Read a configuration by shipped name or by file name.

    Raises
    ------
    ConfigError
        If no such configuration exists, or a key or value is invalid; one line per error.
    """
    return compose(_raw(name), str(name))


def compose(raw: Mapping[str, Any], name: str) -> Config:
    """Validate a configuration that has been read; ``name`` identifies it in error messages.

    Raises
    ------
    ConfigError
        If a key or value is invalid; one line per error.
    """
    stages = list(stage_models())
    _reject_unknown_keys(raw, ["dataset", *stages, "export", "cluster", "variants"], name, "")
    variants = _mapping(raw.get("variants") or {"flexroad": {}}, name, "variants")
    base = {
        stage: _merge(DEFAULTS.get(stage), raw.get(stage), TAG.get(stage), f"{name}: {stage}")
        for stage in stages
    }
    chains = {}
    for variant, overrides in variants.items():
        where = f"variants.{variant}"
        if not str(variant).replace("-", "").replace("_", "").isalnum():
            raise ConfigError(
                f"{name}: {where}: the name is part of file names; use letters, digits, - and _"
            )
        overrides = _mapping(overrides or {}, name, where)
        _reject_unknown_keys(overrides, stages, name, where)
        chains[str(variant)] = {
            stage: _validate(
                stage_models()[stage],
                _merge(base[stage], overrides.get(stage), TAG.get(stage), f"{name}: {where}.{stage}"),
                f"{name}: {where}.{stage}" if stage in overrides else f"{name}: {stage}",
            )
            for stage in stages
        }
    export = _validate(
        TypeAdapter(Export), raw.get("export") or {"variants": _main_variant(chains)}, f"{name}: export"
    )
    for variant in export.variants:
        if variant not in chains:
            raise ConfigError(f"{name}: export.variants: no variant {variant!r}, only {', '.join(chains)}")
    options = _merge({}, raw.get("cluster"), TAG["cluster"], f"{name}: cluster")
    cluster = _validate(TypeAdapter(Cluster), options, f"{name}: cluster")
    dataset = _mapping(raw.get("dataset") or {}, name, "dataset")
    return Config(name=name, chains=chains, export=export, cluster=cluster, dataset=dataset, raw=dict(raw))


def _raw(name: str | Path, children: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the file's mapping merged over its parents; ``children`` are the files that extend it."""
    configs = shipped()
    path = configs.get(str(name), Path(name))
    if not path.is_file():
        near = difflib.get_close_matches(Path(name).name, configs, n=1)
        hint = f"; did you mean {near[0]}?" if near else f"; shipped are {', '.join(configs)}"
        raise ConfigError(f"no configuration {str(name)!r}: neither a file nor a shipped name{hint}")
    if path.resolve() in children:
        raise ConfigError(f"{path}: extends: the file extends itself; name another file or paper")
    try:
        raw = yaml.safe_load(path.read_text()) or {}
    except (yaml.YAMLError, OSError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from error
    raw = _mapping(raw, str(name), "the file")
    parent = raw.pop("extends", None)
    if parent is None:
        return raw
    if not isinstance(parent, str):
        raise ConfigError(f"{name}: extends: expected a file or a shipped name, not {parent!r}")
    if parent not in configs:
        # The parent's path is relative to the file, not to the working directory.
        parent = path.parent / parent
    return _extend(_raw(parent, (*children, path.resolve())), raw)


def _extend(parent: dict[str, Any], child: dict[str, Any]) -> dict[str, Any]:
    merged = dict(parent)
    for key, value in child.items():
        if key in ("variants", "export", "dataset"):
            merged[key] = value
        else:
            # A parent without a method has the default one; another method starts from its own defaults.
            base = _merge(DEFAULTS.get(key), parent.get(key), TAG.get(key), key)
            merged[key] = _merge(base, value, TAG.get(key), key)
    return merged


def _merge(base: Any, override: Any, tag: str | None, where: str) -> dict[str, Any]:
    """Merge an override into a stage's options; an override with another method replaces them."""
    options, changes = _tagged(base, tag, where), _tagged(override, tag, where)
    if tag in changes and tag in options and changes[tag] != options[tag]:
        return changes
    return options | changes


def _tagged(options: Any, tag: str | None, where: str) -> dict[str, Any]:
    if options is None:
        return {}
    # YAML reads a bare `off` as false.
    if isinstance(options, str | bool) and tag:
        return {tag: options if isinstance(options, str) else ("on" if options else "off")}
    if isinstance(options, dict):
        return dict(options)
    raise ConfigError(f"{where}: expected a mapping of options, not {options!r}")


def _mapping(value: Any, name: str, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{name}: {where}: expected a mapping, not {value!r}")
    return dict(value)


def _reject_unknown_keys(raw: Mapping[str, Any], allowed: list[str], name: str, where: str) -> None:
    for key in raw:
        if key not in allowed:
            raise ConfigError(
                f"{name}: {where + '.' if where else ''}{key}: unknown key{_hint(str(key), allowed)}"
            )


def _hint(key: str, allowed: list[str]) -> str:
    near = difflib.get_close_matches(key, allowed, n=1)
    return f"; did you mean {near[0]}?" if near else f"; valid are {', '.join(allowed)}"


def _validate(model: TypeAdapter[Any], options: dict[str, Any], where: str) -> Any:
    try:
        return model.validate_python(options)
    except ValidationError as error:
        lines = [_error_line(details, model, where) for details in error.errors()]
        raise ConfigError("\n".join(lines)) from None


def _error_line(details: Any, model: TypeAdapter[Any], where: str) -> str:
    """Return one of pydantic's errors as a line with key, message and value."""
    # A discriminated union puts the chosen method first in the path; the file has no such level.
    keys = _keys(model)
    method = next((str(part) for part in details["loc"][:1] if part in keys), "")
    path = [str(part) for part in details["loc"][bool(method) :]]
    key = ".".join([where, *path])
    if details["type"] == "extra_forbidden":
        if len(path) > 1:
            return f"{key}: unknown key{RENAMED.get(path[-1]) or _hint(path[-1], _nested_keys(model))}"
        return f"{key}: unknown key{_remedy(path[-1], method, keys)}"
    if details["type"] == "union_tag_invalid":
        tag = details["ctx"]["tag"]
        return f"{key}: there is no method {tag!r}{RENAMED.get(tag) or _hint(tag, sorted(keys))}"
    message = details["msg"].removeprefix("Value error, ")
    if isinstance(details["input"], dict):
        # The message of an error about several options contains their values.
        return f"{key}: {message[0].lower()}{message[1:]}"
    return f"{key}: {message[0].lower()}{message[1:]}, not {details['input']!r}"


def _remedy(key: str, method: str, keys: Mapping[str, list[str]]) -> str:
    others = [name for name, options in keys.items() if key in options and name != method]
    if key not in RENAMED and others:
        return f"; it is an option of method {' and '.join(others)}, not of {method}"
    return RENAMED.get(key) or _hint(key, keys[method])


def _keys(model: TypeAdapter[Any]) -> dict[str, list[str]]:
    """Return the option names of a stage by method; the method is ``""`` for a stage without methods."""
    schema = model.json_schema()
    tags = schema.get("discriminator", {}).get("mapping", {"": ""})
    parts = {tag: schema["$defs"][ref.rpartition("/")[2]] if ref else schema for tag, ref in tags.items()}
    return {tag: sorted(part.get("properties", {})) for tag, part in parts.items()}


def _nested_keys(model: TypeAdapter[Any]) -> list[str]:
    """Return the names of all options within options, such as those of the mask cleanup."""
    parts = model.json_schema().get("$defs", {}).values()
    return sorted({key for part in parts for key in part.get("properties", {})})


def _main_variant(chains: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the variant that is exported by default: ``flexroad``, or else the last one."""
    return ("flexroad",) if "flexroad" in chains else tuple(chains)[-1:]
