"""``flexroad train``: the model of a segmenter that learns, from labels of one's own."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

import typer


def train(
    catalog: Annotated[Path, typer.Argument(metavar="CATALOG")],
    method: Annotated[
        Literal["pixels", "dinov2"],
        typer.Option(help="pixels: trees on cells, in seconds, with or without photo; dinov2: on the photo."),
    ],
    labels: Annotated[
        Literal["mask", "vector"],
        typer.Option(help="mask: the catalog's true road or road mask; vector: its roads as lines or areas."),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="MODEL", help="File to write, its report beside it.")
    ],
    config: Annotated[
        str, typer.Option(help="Configuration whose options of load and segment are used.")
    ] = "paper",
    validation: Annotated[
        float, typer.Option(min=0.05, max=0.9, help="Share of the tiles to judge by: one block apart.")
    ] = 0.3,
    gap_m: Annotated[
        float, typer.Option("--gap-m", min=0, help="Learn from no cell nearer to those tiles (m).")
    ] = 50.0,
    ignore_m: Annotated[
        float, typer.Option("--ignore-m", min=0, help="Learn from no cell nearer to an edge of labels (m).")
    ] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same split and model.")] = 0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting of the method's training; repeatable."),
    ] = None,
) -> None:
    """Train a segmenter on labelled tiles and judge it on others: MODEL, MODEL.html, MODEL.json."""
    from flexroad.catalog import Catalog
    from flexroad.pipeline.config.loading import load_config
    from flexroad.pipeline.errors import ConfigError
    from flexroad.pipeline.report.training import summary, write_model
    from flexroad.pipeline.store.artefacts import check_writable
    from flexroad.pipeline.training.train import TrainOptions, train
    from flexroad.tasks.errors import TaskError

    asked = TrainOptions(method, labels, validation, gap_m, ignore_m, seed, _settings(settings or []))
    found, chosen = Catalog.read(catalog), load_config(config)
    output.parent.mkdir(parents=True, exist_ok=True)
    check_writable(output.parent)
    try:
        outcome = train(found, chosen, asked, lambda line: typer.echo(line, err=True))
        model, page, _ = write_model(outcome, output)
    except TaskError as error:
        raise ConfigError(str(error)) from error
    for note in outcome.notes:
        typer.echo(f"note: {note}", err=True)
    typer.echo(f"{model}: {summary(outcome)}")
    typer.echo(f"report: {page}")
    typer.echo(f"next: in a configuration, segment: {{method: {method}, model: {shlex.quote(str(model))}}}")


def _settings(words: list[str]) -> dict[str, Any]:
    """Return settings by name; values are read as YAML has them."""
    import yaml

    from flexroad.pipeline.errors import ConfigError

    found: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        try:
            found[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {word}: not readable as NAME=VALUE") from error
        if not equals:
            raise ConfigError(f"--set {word}: give NAME=VALUE, like --set rounds=100")
    return found
