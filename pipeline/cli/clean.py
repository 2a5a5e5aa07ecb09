"""``flexroad clean``: delete files that no run needs."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

import typer

from flexroad.catalog.storage.paths import absolute, parse_location
from flexroad.catalog.storage.scratch import abandoned, remove_abandoned
from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.cleanup import MEANING, delete, exclusive, find_garbage
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run, check_links, runs_using, unregister

app = group()


@app.command(cls=Command)
def clean(
    ctx: typer.Context,
    path: options.Run,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the files, delete nothing.")] = False,
    forget: Annotated[
        list[str] | None,
        typer.Option(metavar="RUN", help="Another run of the same store that no longer exists; repeatable."),
    ] = None,
) -> None:
    """Delete files that no run needs.

    These are unused stage results, files of removed tiles and products, and temporary files.
    """

    def say(line: str) -> None:
        echo(f"note: {line}", err=True)

    location, forgotten = parse_location(path), [absolute(parse_location(text)) for text in forget or ()]
    check_links(location)
    with run_lock(location, say):
        run = Run.open(location, options.allowed(ctx))
        users = {str(user) for user in runs_using(run.store)}
        for user in forgotten:
            if str(user) not in users:
                choices = ", ".join(sorted(users)) or "none"
                raise ConfigError(
                    f"--forget {user}: no run of the store {run.store}; its runs are: {choices}"
                )
        files, sizes = Counter[str](), Counter[str]()
        with exclusive(run, forgotten, say, options.allowed(ctx)) as runs:
            garbage = find_garbage(runs)
            for file in garbage if dry_run else delete(garbage):
                files[file.kind] += 1
                sizes[file.kind] += file.size
                if dry_run:
                    echo(str(file.path))
            for user in () if dry_run else forgotten:
                unregister(run.store, user)
    for kind, meaning in MEANING.items():
        if files[kind]:
            echo(f"{meaning}: {count(files[kind], 'file')}, {sizes[kind] / 1e6:.1f} MB")
    folders = sum(1 for _ in abandoned()) if dry_run else remove_abandoned()
    if folders:
        echo(f"temporary folders of processes that were killed: {folders}")
    verb = "would free" if dry_run else "freed"
    echo(f"{verb} {count(files.total(), 'file')}, {sizes.total() / 1e6:.1f} MB")
