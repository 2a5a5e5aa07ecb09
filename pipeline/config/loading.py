"""Read a configuration from YAML, resolve `extends`, and validate it; one line per error.

A file without ``extends`` extends `USUAL`. The last file of a chain has ``extends: defaults``.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from flexroad.catalog.storage.paths import stat
from flexroad.catalog.text import printable, shown
from flexroad.pipeline.config import document
from flexroad.pipeline.config.models import ROOT, TAG, Cluster, Config, Export, stage_models
from flexroad.pipeline.config.settings import applied, merge, parsed, texts
from flexroad.pipeline.config.stages import DEFAULTS
from flexroad.pipeline.errors import ConfigError

SECTIONS = ("dataset", "export", "cluster", "variants", "extends")
"""Parts of a configuration that are not stages."""
USUAL = "production"
"""The configuration that a file without ``extends`` extends."""
SUFFIXES = (".yaml", ".yml")
"""Endings of the files that may be extended."""
MAX_PARENTS = 10
"""Longest chain of files that extend each other."""
MAX_VARIANT = 80
"""Longest name of a variant (bytes in UTF-8), which is a part of names of files."""
MAX_KEY = 60
"""Longest text of a key in a message."""
MAX_NAME = 500
"""Longest name of a missing file in a message."""
MAX_ERRORS = 10
"""Most errors of one stage that are listed."""
HALO_M = 40.0
"""Smallest halo (m) with levels: levels at the border of a tile depend on nothing farther away."""


def shipped() -> dict[str, Path]:
    """Return the configurations that come with the program, by name."""
    # In a checkout the package's folders are links; resolve() leads to the root, which has configs/.
    folder = Path(__file__).resolve().parents[2] / "configs"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_config(name: str | Path, settings: Sequence[str] | Mapping[str, Any] = ()) -> Config:
    """Read a configuration by shipped name or by file name.

    - `settings`: options that replace options of the file: ``["fit.spacing_m=5"]`` or ``{"fit":
      {"spacing_m": 5}}``. They become part of the configuration's name, to distinguish its results.
    """
    config = compose(_raw(name), str(name))
    if not settings:
        return config
    given = texts(settings)
    changed = applied(config.raw, map(parsed, given))
    return compose(changed, " ".join([str(name), *(f"--set {printable(text)}" for text in given)]))


def compose(raw: Mapping[str, Any], name: str) -> Config:
    """Validate a configuration that does not extend another; ``name`` identifies it in error messages."""
    stages = list(stage_models())
    raw = {"extends": ROOT, **raw}
    if raw["extends"] != ROOT:
        raise ConfigError(
            f"{name}: extends: only files extend others, not {shown(raw['extends'])}; remove it"
        )
    _reject_unknown_keys(raw, [*stages, *SECTIONS], name, "")
    variants = _mapping(raw.get("variants") or {"flexroad": {}}, name, "variants")
    base = {
        stage: merge(DEFAULTS.get(stage), raw.get(stage), TAG.get(stage), f"{name}: {stage}")
        for stage in stages
    }
    chains = {}
    for variant, overrides in variants.items():
        _check_variant(str(variant), name)
        where = f"variants.{variant}"
        overrides = _mapping(overrides or {}, name, where)
        _reject_unknown_keys(overrides, stages, name, where)
        chains[str(variant)] = {
            stage: _validate(
                stage_models()[stage],
                merge(base[stage], overrides.get(stage), TAG.get(stage), f"{name}: {where}.{stage}"),
                f"{name}: {where}.{stage}" if stage in overrides else f"{name}: {stage}",
            )
            for stage in stages
        }
        _check_levels(chains[str(variant)], f"{name}: {where}" if overrides else name)
    given = _mapping(raw.get("export") or {}, name, "export")
    # By default the variant ``flexroad`` is exported, else the last variant.
    main = ("flexroad",) if "flexroad" in chains else tuple(chains)[-1:]
    export = _validate(TypeAdapter(Export), {"variants": main} | given, f"{name}: export")
    for variant in export.variants:
        if variant not in chains:
            raise ConfigError(
                f"{name}: export.variants: no variant {shown(variant)}, only {', '.join(chains)}"
            )
    options = merge({}, raw.get("cluster"), TAG["cluster"], f"{name}: cluster")
    cluster = _validate(TypeAdapter(Cluster), options, f"{name}: cluster")
    dataset = _mapping(raw.get("dataset") or {}, name, "dataset")
    if wrong := [key for key in dataset if not isinstance(key, str)]:
        raise ConfigError(f"{name}: dataset: the key {shown(wrong[0])} is not a text; correct or remove it")
    return Config(name=name, chains=chains, export=export, cluster=cluster, dataset=dataset, raw=raw)


def read_mapping(data: bytes, name: str) -> dict[str, Any]:
    """Return the mapping in a configuration file's bytes, with ``extends`` unresolved."""
    return _mapping_of(document.parse(data, name)[0], name)


def _raw(name: str | Path) -> dict[str, Any]:
    """Return the file's mapping merged over its parents."""
    path = _existing(name)
    layers, seen = [_read(path)], [path]
    while (parent := layers[-1].pop("extends", USUAL)) != ROOT:
        path = _parent(parent, path)
        if path.resolve() in (file.resolve() for file in seen):
            raise ConfigError(f"{path}: extends: the file extends itself; name another file or {USUAL}")
        if len(seen) > MAX_PARENTS:
            raise ConfigError(f"{path}: extends: more than {MAX_PARENTS} files extend each other")
        layers.append(_read(path, own=False))
        seen.append(path)
    merged = layers.pop()
    while layers:
        merged = _extend(merged, layers.pop(), str(seen[len(layers)]))
    return merged


def _existing(name: str | Path) -> Path:
    """Return the path of a shipped name or of a file."""
    configs = shipped()
    path, given = configs.get(str(name), Path(name)), _short(name, MAX_NAME)
    if stat(path) is not None:
        return path
    try:
        special = path.exists()
    except OSError as error:
        raise ConfigError(f"configuration '{given}': {error.strerror}; name a YAML file") from error
    if special:
        raise ConfigError(f"configuration '{given}' is not a regular file; name a YAML file")
    begun = [config for config in configs if config.startswith(str(name))]
    near = begun or difflib.get_close_matches(Path(name).name, configs, n=1)
    hint = f"; did you mean {near[0]}?" if near else f"; shipped are {', '.join(configs)}"
    raise ConfigError(f"no configuration '{given}': neither a file nor a shipped name{hint}")


def _parent(parent: Any, path: Path) -> Path:
    """Return the path of the configuration that the file ``path`` extends.

    Another user may have written a configuration, but files are read with this user's rights. So only files
    with YAML's endings are read, also behind links.
    """
    if not isinstance(parent, str):
        raise ConfigError(f"{path}: extends: expected a file or a shipped name, not {shown(parent)}")
    if parent in shipped():
        return _existing(parent)
    # The parent's path is relative to the file, not to the working directory.
    found = _existing(path.parent / parent)
    if not {found.suffix, found.resolve().suffix} <= set(SUFFIXES):
        raise ConfigError(f"{path}: extends: {found} is not a YAML file; its name must end in .yaml or .yml")
    return found


def _read(path: Path, own: bool = True) -> dict[str, Any]:
    """Return the mapping in a file; ``own`` is False for a file that another file extends."""
    try:
        with path.open("rb") as file:
            value, lines = document.parse(file.read(document.MAX_BYTES + 1), str(path))
    except OSError as error:
        raise ConfigError(
            f"cannot read {path}: {error.strerror or error}; name a file that can be"
        ) from error
    raw = _mapping_of(value, str(path))
    for key in () if own else raw:
        if key not in (*SECTIONS, *stage_models()):
            # The file may be something else than a configuration, so its text is not shown.
            line = lines.get(str(key), 1)
            raise ConfigError(
                f"{path}: line {line}: the key is unknown in a configuration; correct or remove it"
            )
    return raw


def _mapping_of(value: Any, name: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        kind = {"list": "a list", "str": "a text"}.get(type(value).__name__, "a single value")
        raise ConfigError(f"{name}: expected a mapping of stages to options, but it is {kind}")
    return dict(value)


def _extend(parent: dict[str, Any], child: dict[str, Any], name: str) -> dict[str, Any]:
    merged = dict(parent)
    for key, value in child.items():
        if key in ("export", "cluster", *stage_models()):
            where = f"{name}: {key}"
            # A parent without a method has the default method; another method starts from its own defaults.
            base = merge(DEFAULTS.get(key), parent.get(key), TAG.get(key), where)
            merged[key] = merge(base, value, TAG.get(key), where)
        elif key == "dataset":
            # `layers` is replaced completely, because the files of datasets are independent of each other.
            merged[key] = _mapping(parent.get(key) or {}, name, key) | _mapping(value or {}, name, key)
        else:
            merged[key] = value
    return merged


def _mapping(value: Any, name: str, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{name}: {where}: expected a mapping, not {shown(value)}")
    return dict(value)


def _check_variant(variant: str, name: str) -> None:
    if not variant.replace("-", "").replace("_", "").isalnum() or len(variant.encode()) > MAX_VARIANT:
        raise ConfigError(
            f"{name}: variants.{_short(variant)}: the name is part of file names; use letters, digits, - "
            f"and _, at most {MAX_VARIANT} bytes"
        )


def _reject_unknown_keys(raw: Mapping[str, Any], allowed: list[str], name: str, where: str) -> None:
    for key in raw:
        if key not in allowed:
            raise ConfigError(
                f"{name}: {where + '.' if where else ''}{_short(key)}: unknown key{_hint(str(key), allowed)}"
            )


def _short(key: object, limit: int = MAX_KEY) -> str:
    """Return a key or the name of a file for messages."""
    text = printable(str(key))
    return text if len(text) <= limit else f"{text[:limit]}..."


def _hint(key: str, allowed: list[str]) -> str:
    near = difflib.get_close_matches(key, allowed, n=1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"; {meant}valid are {', '.join(allowed)}"


def _validate(model: TypeAdapter[Any], options: dict[str, Any], where: str) -> Any:
    try:
        return model.validate_python(options)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        lines = [_error_line(details, model, where) for details in errors[:MAX_ERRORS]]
        if len(errors) > MAX_ERRORS:
            lines.append(f"{where}: {len(errors) - MAX_ERRORS} more errors")
        raise ConfigError("\n".join(lines)) from None


def _error_line(details: Any, model: TypeAdapter[Any], where: str) -> str:
    """Return an error of pydantic as a line with key, message and value."""
    # A discriminated union puts the chosen method first in the path; the file has no such level.
    keys = _keys(model)
    method = next((str(part) for part in details["loc"][:1] if part in keys), "")
    path = [str(part) for part in details["loc"][bool(method) :]]
    key = ".".join([where, *map(_short, path)])
    if details["type"] == "extra_forbidden":
        return f"{key}: unknown key{_remedy(path[-1], method, keys)}"
    if details["type"] == "union_tag_invalid":
        tag = details["ctx"]["tag"]
        return f"{key}: there is no method {shown(tag)}{_hint(tag, sorted(keys))}"
    message = printable(details["msg"].removeprefix("Value error, "))
    if isinstance(details["input"], dict):
        # The message of an error about several options contains their values.
        return f"{key}: {message[0].lower()}{message[1:]}"
    return f"{key}: {message[0].lower()}{message[1:]}, not {shown(details['input'])}"


def _remedy(key: str, method: str, keys: Mapping[str, list[str]]) -> str:
    others = [name for name, options in keys.items() if key in options and name != method]
    if others:
        return f"; it is an option of method {' and '.join(others)}, not of {method}"
    return _hint(key, keys[method])


def _keys(model: TypeAdapter[Any]) -> dict[str, list[str]]:
    """Return the option names of a stage by method; the method is ``""`` for a stage without methods."""
    schema = model.json_schema()
    tags = schema.get("discriminator", {}).get("mapping", {"": ""})
    parts = {tag: schema["$defs"][ref.rpartition("/")[2]] if ref else schema for tag, ref in tags.items()}
    return {tag: sorted(part.get("properties", {})) for tag, part in parts.items()}


def _check_levels(chain: Mapping[str, Any], where: str) -> None:
    """Check that the stages of a variant can compute levels, if its segmentation has them."""
    if not getattr(chain["segment"], "levels", False):
        return
    load, sample = chain["load"], chain["sample"]
    needs = [
        (chain["ecsrc"].method == "planar", f"ecsrc: planar, not {chain['ecsrc'].method}"),
        (chain["fit"].method == "smoothing_spline", f"fit: smoothing_spline, not {chain['fit'].method}"),
        (load.halo_m >= HALO_M, f"load.halo_m of {HALO_M:g} or more, not {load.halo_m:g}"),
        (sample.method == "dynamic", f"sample.method dynamic, not {sample.method}"),
        (sample.mask == "raw", f"sample.mask raw, not {sample.mask}"),
    ]
    for fine, needed in needs:
        if not fine:
            raise ConfigError(
                f"{where}: segment.levels needs {needed}; set it, or set segment.levels to false"
            )
