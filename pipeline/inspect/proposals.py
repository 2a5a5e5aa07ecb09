"""The commands that make a catalog of a folder of downloads."""

from __future__ import annotations

import glob
import os
import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flexroad.pipeline.inspect.downloads import Download

LAYERS = ("dsm", "dtm", "road_height", "dop", "road_mask")
"""Layers that rasters are given for."""
LAYER = "--roads-layer with the layer of the roads"
"""What to add for a vector file of several layers."""


@dataclass(frozen=True)
class Proposal:
    """A command that makes a catalog, and what is still open."""

    command: str
    catalog: Path
    """The catalog that it makes."""
    roads: str = ""
    """The layer of roads that the catalog will have; empty if that is not known before."""
    open: str = ""
    """What the user must add to the command; empty if nothing."""


def proposals(folder: Path, found: Sequence[Download]) -> Iterator[Proposal]:
    """Yield the commands that fit the downloads of a folder."""
    by_kind: dict[str, list[Download]] = defaultdict(list)
    for download in found:
        by_kind[download.kind].append(download)
    yield from _of_rasters(folder, by_kind)
    for number, (command, inputs, crs) in enumerate(_sources(folder, by_kind)):
        out = Path(f"{_title(folder)}_{command}{number or ''}")
        roads = _roads(by_kind)
        words = ["flexroad", "prepare", command, *map(str, inputs), "-o", str(out), *roads]
        lacking = [] if roads else ["--roads FILE with the roads of the area"]
        lacking += [LAYER] if roads and by_kind["roads"][0].question else []
        lacking += ["--crs"] if command == "points" and crs is None else []
        catalog = out / "catalog.parquet"
        # Areas become a road mask, lines stay vectors: the command itself says what comes next.
        yield Proposal(shlex.join(words), catalog, "", _listed(lacking))


def _title(folder: Path) -> str:
    return folder.resolve().name or "data"


def _roads(by_kind: Mapping[str, Sequence[Download]]) -> list[str]:
    """Return the option that names the vector file of roads, if there is just one."""
    files = by_kind["roads"]
    return ["--roads", str(files[0].path.absolute())] if len(files) == 1 else []


def _sources(
    folder: Path, by_kind: Mapping[str, Sequence[Download]]
) -> Iterator[tuple[str, list[Path], str | None]]:
    """Yield the inputs of each ``flexroad prepare`` command, with their CRS."""
    if any((folder / name).is_dir() for name in ("odm_dem", "odm_texturing", "odm_orthophoto")):
        yield "odm", [folder], None
        return
    clouds = by_kind["cloud"]
    for crs in dict.fromkeys(cloud.crs for cloud in clouds):
        files = [cloud.path for cloud in clouds if cloud.crs == crs]
        others = {cloud.path.parent for cloud in clouds if cloud.crs != crs}
        # A folder stands for its files if they belong together.
        names = dict.fromkeys(file if file.parent in others else file.parent for file in files)
        yield "points", list(names), crs
    for mesh in by_kind["mesh"]:
        yield "mesh", [mesh.path], None
    textures = {mesh.path.parent for mesh in by_kind["mesh"]}
    if photos := {photo.path.parent for photo in by_kind["photo"]} - textures:
        yield "photos", sorted(photos), None


def _of_rasters(folder: Path, by_kind: Mapping[str, Sequence[Download]]) -> Iterator[Proposal]:
    """Yield a command for the rasters of each CRS, or one for all if the surface models have the same.

    Downloads of Geobasis NRW have a command of their own.
    """
    from flexroad.catalog.sources import nrw

    rasters = [download for layer in LAYERS for download in by_kind[layer]]
    systems = dict.fromkeys(download.crs for download in rasters if download.kind in ("dsm", "dtm"))
    surfaces = dict.fromkeys(download.crs for download in by_kind["dsm"])
    # A layer in another CRS is warped onto the only one of the surface models.
    mixed = len(surfaces) == 1 and any(d.crs not in (None, *surfaces) for d in rasters)
    for number, crs in enumerate(surfaces if mixed else systems):
        chosen = [d for d in rasters if d.crs == crs or (mixed and d.crs is not None)]
        output = Path(f"{_title(folder)}{number + 1 if number else ''}.parquet")
        layers = {download.kind for download in chosen}
        lacking = [f"--{layer} FILES" for layer in ("dsm", "dtm") if layer not in layers]
        words = ["flexroad", "catalog", "rasters", str(folder)]
        if any(nrw.parse(download.path) for download in chosen if download.kind == "dsm"):
            words = ["flexroad", "catalog", "nrw", str(folder)]
            layers, lacking = layers & {"road_mask"}, ["the DTM (dgm1)"] if "dtm" not in layers else []
        for layer in (layer for layer in LAYERS if layer in layers):
            pattern = _pattern(folder, [download.path for download in chosen if download.kind == layer])
            if pattern:
                words += [f"--{layer.replace('_', '-')}", pattern]
            else:
                lacking.append(f"--{layer.replace('_', '-')} FILES: no one pattern has just these files")
        in_metres = all(download.metric for download in chosen if download.kind == "dsm")
        words += ["--reproject"] if mixed or not in_metres else []
        lacking += [] if in_metres else ["--to-crs with a CRS in metres"]
        roads = [] if "road_mask" in layers else _roads(by_kind)
        words += roads
        has = "road_mask" if "road_mask" in layers else "roads" if roads else ""
        if roads and by_kind["roads"][0].question:
            lacking.append(LAYER)
        if not has:
            lacking.append("--road-mask or --roads with the roads")
        if any(download.question for download in chosen if download.kind == "road_mask"):
            lacking.append("--road-value with the values of the mask that are road")
        if crs is None:
            lacking.append("--crs")
        yield Proposal(shlex.join([*words, "-o", str(output)]), output, has, _listed(lacking))


def _listed(lacking: Sequence[str]) -> str:
    return f"add {'; '.join(lacking)}" if lacking else ""


def _pattern(folder: Path, paths: Sequence[Path]) -> str | None:
    """Return a pattern relative to a folder that matches these files and no others, None if there is none."""
    names = sorted(path.relative_to(folder).as_posix() for path in paths)
    if len(names) == 1:
        return glob.escape(names[0])
    start = os.path.commonprefix(names)  # noqa: RUF071 (of characters)
    end = os.path.commonprefix([name[::-1] for name in names])[::-1]  # noqa: RUF071
    above = start[: start.rfind("/") + 1]
    # Whole names are replaced first: what next year's files have in common with these is not known.
    for first, middle, last in (
        (above, "*", Path(names[0]).suffix),
        (start, "*", end),
        (start, "**/*", end),
    ):
        pattern = glob.escape(first) + middle + glob.escape(last)
        try:
            matched = sorted(path.relative_to(folder).as_posix() for path in folder.glob(pattern))
        except ValueError:
            continue
        if matched == names:
            return pattern
    return None
