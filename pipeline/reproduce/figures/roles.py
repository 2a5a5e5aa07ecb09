"""Which variant plays which part in the figures: told by its options, whatever its name."""

from __future__ import annotations

from dataclasses import dataclass

from flexroad.pipeline.config.models import Chain, Config


@dataclass(frozen=True)
class Roles:
    """Variants by their part; None where a run has none."""

    full: str
    """FlexRoad itself: what the others are compared with."""
    plane: str | None = None
    rgt: str | None = None
    wo_nurbs: str | None = None
    wo_ecsrc: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """All variants that play."""
        parts = (self.full, self.plane, self.rgt, self.wo_nurbs, self.wo_ecsrc)
        return tuple(name for name in parts if name is not None)


def roles_of(config: Config) -> Roles:
    """Find the parts in a configuration; FlexRoad is its first exported variant."""
    full = config.export.variants[0]
    found: dict[str, str] = {}
    for name, chain in config.chains.items():
        part = _part(chain, config.chains[full])
        if part:
            found.setdefault(part, name)
    return Roles(full, **found)


def _part(chain: Chain, full: Chain) -> str:
    fit = chain["fit"].model_dump()
    if fit["method"] == "plane":
        return "plane"
    if fit["method"] == "raster" and fit["road"] == "dsm":
        return {"dsm": "rgt", "dtm": "wo_nurbs"}[fit["terrain"]]
    return "wo_ecsrc" if changes(chain, full) == {"ecsrc.method"} else ""


def changes(chain: Chain, full: Chain) -> set[str]:
    """Return the options that a variant changes, each as ``stage.option``.

    Of a stage with another method that is its method alone: the options of two methods do not compare.
    """
    found = set()
    for stage, options in chain.items():
        mine, other = options.model_dump(), full[stage].model_dump()
        if mine.get("method") != other.get("method"):
            found.add(f"{stage}.method")
        else:
            found |= {f"{stage}.{key}" for key in mine if mine[key] != other[key]}
    return found
