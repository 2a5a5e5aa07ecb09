"""Read a configuration from YAML, resolve what it extends, and validate it; one line per fault."""

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
    "huber_m": SPLINE,
    "bending_m3": SPLINE,
    "bending_terrain": SPLINE,
}
"""Words of earlier versions, and what stands for them."""


def shipped() -> dict[str, Path]:
    """Return the configurations that come with the program, by name."""
    # In a checkout the package is a link to this folder, and the configurations lie beside it, too.
    folder = Path(__file__).resolve().parents[2] / "configs"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_config(name: str | Path) -> Config:
    """Read a configuration by shipped name or by file name.

    Raises
    ------
    ConfigError
        If there is none of that name or a key or value is wrong; one line per fault.
    """
    return compose(_raw(name), str(name))


def compose(raw: Mapping[str, Any], name: str) -> Config:
    """Validate a configuration already read; ``name`` is what errors call it."""
    stages = list(stage_models())
    known = ["dataset", *stages, "export", "cluster", "variants"]
    _refuse_unknown(raw, known, name, "")
    variants = _mapping(raw.get("variants") or {"flexroad": {}}, name, "variants")
    base = {
        stage: _merge(DEFAULTS.get(stage), raw.get(stage), TAG.get(stage), f"{name}: {stage}")
        for stage in stages
    }
    chains = {}
    for variant, overrides in variants.items():
        where = f"variants.{variant}"
        if not str(variant).replace("-", "").replace("_", "").isalnum():
            raise ConfigError(f"{name}: {where}: its files bear the name; use letters, digits, - and _")
        overrides = _mapping(overrides or {}, name, where)
        _refuse_unknown(overrides, stages, name, where)
        chains[str(variant)] = {
            stage: _validate(
                stage_models()[stage],
                _merge(base[stage], overrides.get(stage), TAG.get(stage), f"{name}: {where}.{stage}"),
                f"{name}: {where}.{stage}" if stage in overrides else f"{name}: {stage}",
            )
            for stage in stages
        }
    export = _validate(
        TypeAdapter(Export), raw.get("export") or {"variants": _main(chains)}, f"{name}: export"
    )
    for variant in export.variants:
        if variant not in chains:
            raise ConfigError(f"{name}: export.variants: no variant {variant!r}, only {', '.join(chains)}")
    workers = _merge({}, raw.get("cluster"), TAG["cluster"], f"{name}: cluster")
    cluster = _validate(TypeAdapter(Cluster), workers, f"{name}: cluster")
    dataset = _mapping(raw.get("dataset") or {}, name, "dataset")
    return Config(name=name, chains=chains, export=export, cluster=cluster, dataset=dataset, raw=dict(raw))


def _raw(name: str | Path, heirs: tuple[Path, ...] = ()) -> dict[str, Any]:
    known = shipped()
    path = known.get(str(name), Path(name))
    if not path.is_file():
        near = difflib.get_close_matches(Path(name).name, known, n=1)
        hint = f"; did you mean {near[0]}?" if near else f"; shipped are {', '.join(known)}"
        raise ConfigError(f"no configuration {str(name)!r}: neither a file nor a shipped name{hint}")
    if path.resolve() in heirs:
        raise ConfigError(f"{path}: extends: leads back to itself; name another file or paper")
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
    if parent not in known:
        # A file names its parent as it sees it, wherever the command is given.
        parent = path.parent / parent
    return _extend(_raw(parent, (*heirs, path.resolve())), raw)


def _extend(parent: dict[str, Any], child: dict[str, Any]) -> dict[str, Any]:
    merged = dict(parent)
    for key, value in child.items():
        if key in ("variants", "export", "dataset"):
            merged[key] = value
        else:
            # A parent that names no method has the usual one, and another starts from its own defaults.
            below = _merge(DEFAULTS.get(key), parent.get(key), TAG.get(key), key)
            merged[key] = _merge(below, value, TAG.get(key), key)
    return merged


def _merge(base: Any, override: Any, tag: str | None, where: str) -> dict[str, Any]:
    """Lay an override over a stage's options; another method starts from its own defaults."""
    below, above = _tagged(base, tag, where), _tagged(override, tag, where)
    if tag in above and tag in below and above[tag] != below[tag]:
        return above
    return below | above


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


def _refuse_unknown(raw: Mapping[str, Any], known: list[str], name: str, where: str) -> None:
    for key in raw:
        if key not in known:
            raise ConfigError(
                f"{name}: {where + '.' if where else ''}{key}: unknown key{_hint(str(key), known)}"
            )


def _hint(key: str, known: list[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1)
    return f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}"


def _validate(model: TypeAdapter[Any], options: dict[str, Any], where: str) -> Any:
    try:
        return model.validate_python(options)
    except ValidationError as error:
        faults = [_fault(fault, model, where) for fault in error.errors()]
        raise ConfigError("\n".join(faults)) from None


def _fault(fault: Any, model: TypeAdapter[Any], where: str) -> str:
    # A discriminated union puts the chosen method first in the path; the file has no such level.
    keys = _keys(model)
    method = next((str(part) for part in fault["loc"][:1] if part in keys), "")
    path = [str(part) for part in fault["loc"][bool(method) :]]
    key = ".".join([where, *path])
    if fault["type"] == "extra_forbidden":
        return f"{key}: unknown key{_remedy(path[-1], method, keys)}"
    if fault["type"] == "union_tag_invalid":
        tag = fault["ctx"]["tag"]
        return f"{key}: there is no method {tag!r}{RENAMED.get(tag) or _hint(tag, sorted(keys))}"
    message = fault["msg"].removeprefix("Value error, ")
    if isinstance(fault["input"], dict):
        # A fault of several options together has told their values itself.
        return f"{key}: {message[0].lower()}{message[1:]}"
    return f"{key}: {message[0].lower()}{message[1:]}, not {fault['input']!r}"


def _remedy(key: str, method: str, keys: Mapping[str, list[str]]) -> str:
    others = [name for name, known in keys.items() if key in known and name != method]
    if key not in RENAMED and others:
        return f"; it is an option of method {' and '.join(others)}, not of {method}"
    return RENAMED.get(key) or _hint(key, keys[method])


def _keys(model: TypeAdapter[Any]) -> dict[str, list[str]]:
    """Return the options of each method of a stage; of a stage without methods, those of ``""``."""
    schema = model.json_schema()
    tags = schema.get("discriminator", {}).get("mapping", {"": ""})
    parts = {tag: schema["$defs"][ref.rpartition("/")[2]] if ref else schema for tag, ref in tags.items()}
    found = {tag: list(part.get("properties", {})) for tag, part in parts.items()}
    # Options within options, such as how a mask is cleaned.
    within = [key for part in schema.get("$defs", {}).values() for key in part.get("properties", {})]
    return {tag: sorted({*own, *(within if tags == {"": ""} else ())}) for tag, own in found.items()}


def _main(chains: Mapping[str, Any]) -> tuple[str, ...]:
    return ("flexroad",) if "flexroad" in chains else tuple(chains)[-1:]
