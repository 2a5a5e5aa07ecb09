"""Compose the stages' option models into one configuration; the only reader of configs.

A configuration holds one set of options per stage, and variants: named overrides of them. A variant is
never a code path, only other options for the same chain of stages. A stage given as a bare word means its
method: ``fit: plane`` is ``fit: {method: plane}``.
"""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args

import yaml
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from flexroad.pipeline.cluster import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import load, sample
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.options import Options
from flexroad.tasks.quality import assess

TAG = {"segment": "method", "ecsrc": "method", "fit": "method", "sample": "method", "cluster": "kind"}
"""The option that a bare word stands for, by stage or section."""

NO_METHODS = ("kit", "training_types")
"""What lies in a package of methods beside them."""

Chain = Mapping[str, Options]
"""The options of one variant, by stage, in the paper's order."""

Format = Literal["glb", "ply", "cog", "npz"]


class Export(Options):
    """What is written for the user, beside the metrics."""

    variants: tuple[str, ...] = Field(
        ("flexroad",),
        min_length=1,
        description="variants whose meshes are kept; query asks the first",
    )
    formats: tuple[Format, ...] = Field(
        ("glb", "ply", "cog", "npz"),
        description="glb and ply: the mesh; cog: height and road mask; npz: the NURBS surface itself",
    )


class Config(BaseModel):
    """A whole run: the chain of every variant, what is exported, and who works."""

    model_config = {"frozen": True, "arbitrary_types_allowed": True}

    name: str
    chains: dict[str, dict[str, Any]]
    """Variant -> stage -> options (`Options`), in the file's and the paper's order."""
    export: Export
    cluster: Cluster
    dataset: dict[str, Any]
    """Where a published dataset's files lie: for `catalog.sources`, which checks it."""
    raw: dict[str, Any]
    """The resolved file, as written to the run's config.yaml."""


@cache
def methods(package: str) -> dict[str, Any]:
    """Return the stage files of a package by method: NAME.py, or NAME/segment.py of one that learns."""
    home = importlib.import_module(package)
    stage = package.rpartition(".")[2]
    found: dict[str, Any] = {}
    for file in sorted(pkgutil.iter_modules(home.__path__), key=lambda file: file.name):
        if file.name not in NO_METHODS:
            module = importlib.import_module(f"{package}.{file.name}{f'.{stage}' if file.ispkg else ''}")
            found |= dict.fromkeys(get_args(module.Options.model_fields["method"].annotation), module)
    return found


@cache
def stage_models() -> dict[str, TypeAdapter[Options]]:
    """Return what validates the options of each stage, in the paper's order."""

    def one_of(package: str) -> TypeAdapter[Options]:
        models: Any = tuple(dict.fromkeys(module.Options for module in methods(package).values()))
        if len(models) == 1:
            return TypeAdapter(models[0])
        union: Any = Union[models]  # noqa: UP007 (which models there are is known only now)
        chosen: Any = Annotated[union, Field(discriminator="method")]
        return TypeAdapter(chosen)

    return {
        "load": TypeAdapter(load.Options),
        "segment": one_of("flexroad.tasks.segment"),
        "ecsrc": one_of("flexroad.tasks.filter"),
        "fit": one_of("flexroad.tasks.fit"),
        "sample": TypeAdapter(sample.Options),
        "evaluate": TypeAdapter(evaluate.Options),
        "assess": TypeAdapter(assess.Options),
    }


DEFAULTS: dict[str, dict[str, Any]] = {
    "segment": {"method": "mask"},
    "ecsrc": {"method": "paper"},
    "fit": {"method": "nurbs"},
}
"""Methods of stages that have several, where a file names none."""


def shipped() -> dict[str, Path]:
    """Return the configurations that come with the program, by name."""
    # In a checkout the package is a link to this folder, and the configurations lie beside it, too.
    folder = Path(__file__).resolve().parents[1] / "configs"
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
        stage: _merge(DEFAULTS.get(stage, {}), raw.get(stage), TAG.get(stage), f"{name}: {stage}")
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


def schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file, for editors."""
    stages = {stage: model.json_schema() for stage, model in stage_models().items()}
    override = {stage: {"anyOf": [{"type": "string"}, {"type": "object"}]} for stage in stages}
    variant = {"type": ["object", "null"], "properties": override, "additionalProperties": False}
    properties = {
        "extends": {"type": "string", "description": "name of the configuration this one overrides"},
        "dataset": {"type": "object", "description": "where a dataset's files lie: layers, road_values, crs"},
        **stages,
        "export": Export.model_json_schema(),
        "cluster": {"anyOf": [{"type": "string"}, Cluster.model_json_schema()]},
        "variants": {"type": "object", "additionalProperties": variant},
    }
    return {"type": "object", "properties": properties, "additionalProperties": False}


def template() -> str:
    """Return a configuration file with every option at its default and its meaning beside it."""
    lines = ["# Every option with its default. Delete what you do not change."]
    packages = {
        "segment": "flexroad.tasks.segment",
        "ecsrc": "flexroad.tasks.filter",
        "fit": "flexroad.tasks.fit",
    }
    singles = {"load": load, "sample": sample, "evaluate": evaluate, "assess": assess}
    for stage in stage_models():
        lines.append(f"{stage}:")
        if stage in packages:
            default = DEFAULTS[stage][TAG[stage]]
            lines += _option_lines(methods(packages[stage])[default].Options)
            others = [name for name in methods(packages[stage]) if name != default]
            if others:
                lines.append(f"  # other methods: {', '.join(others)}")
        else:
            lines += _option_lines(singles[stage].Options)
    lines += ["export:", *_option_lines(Export), "cluster:", *_option_lines(Cluster)]
    lines += ["variants:", "  flexroad: {}"]
    return "\n".join(lines) + "\n"


def _option_lines(model: type[Options]) -> list[str]:
    lines = []
    for key, field in model.model_fields.items():
        value = field.get_default(call_default_factory=True)
        text = yaml.safe_dump(_plain(value), default_flow_style=True).splitlines()[0]
        meaning = f"  # {' '.join(field.description.split())}" if field.description else ""
        lines.append(f"  {key}: {text}{meaning}")
    return lines


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


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
            below = _merge(DEFAULTS.get(key, {}), parent.get(key), TAG.get(key), key)
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
    tags = model.json_schema().get("discriminator", {}).get("mapping", {})
    path = [str(part) for i, part in enumerate(fault["loc"]) if i or part not in tags]
    key = ".".join([where, *path])
    if fault["type"] == "extra_forbidden":
        return f"{key}: unknown key{_hint(path[-1], _keys(model))}"
    message = fault["msg"].removeprefix("Value error, ")
    if isinstance(fault["input"], dict):
        # A fault of several options together has told their values itself.
        return f"{key}: {message[0].lower()}{message[1:]}"
    return f"{key}: {message[0].lower()}{message[1:]}, not {fault['input']!r}"


def _keys(model: TypeAdapter[Any]) -> list[str]:
    found = model.json_schema()
    models = [found, *found.get("$defs", {}).values()]
    return sorted({key for m in models for key in m.get("properties", {})})


def _main(chains: Mapping[str, Any]) -> tuple[str, ...]:
    return ("flexroad",) if "flexroad" in chains else tuple(chains)[-1:]
