"""``flexroad clean``: free the disk of what no run needs any more."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from flexroad.pipeline.errors import ConfigError


def clean(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Name the files, drop nothing.")] = False,
    forget: Annotated[
        list[str] | None,
        typer.Option(metavar="RUN", help="Another run of the same store that is no more; repeatable."),
    ] = None,
) -> None:
    """Drop what no run needs: artefacts, tiles and products that are gone, leftovers of killed writers."""
    from flexroad.catalog.storage.paths import absolute, parse_location
    from flexroad.pipeline.run.garbage import MEANING, delete, exclusive, find_garbage
    from flexroad.pipeline.run.lock import run_lock
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.run.store_users import runs_using
    from flexroad.pipeline.run.store_users import unregister as strike

    def say(line: str) -> None:
        typer.echo(f"note: {line}", err=True)

    where, gone = parse_location(path), [absolute(parse_location(text)) for text in forget or ()]
    with run_lock(where, say):
        run = Run.open(where)
        known = {str(known) for known in runs_using(run.store)}
        for user in gone:
            if str(user) not in known:
                there = ", ".join(sorted(known)) or "none"
                raise ConfigError(f"--forget {user}: no run of the store {run.store}; there are {there}")
        files, sizes = Counter[str](), Counter[str]()
        with exclusive(run, gone, say) as runs:
            found = find_garbage(runs)
            for file in found if dry_run else delete(found):
                files[file.kind] += 1
                sizes[file.kind] += file.size
                if dry_run:
                    typer.echo(str(file.path))
            for user in () if dry_run else gone:
                strike(run.store, user)
    for kind, meaning in MEANING.items():
        if files[kind]:
            typer.echo(f"{meaning}: {files[kind]} files, {sizes[kind] / 1e6:.1f} MB")
    verb = "would free" if dry_run else "freed"
    typer.echo(f"{verb} {files.total()} files, {sizes.total() / 1e6:.1f} MB")
