"""Which variant of a run is which method of the paper, derived from the variant's options, not its name."""

from __future__ import annotations

from dataclasses import dataclass

from flexroad.pipeline.config.models import Chain, Config


@dataclass(frozen=True)
class Roles:
    """Names of the variants by method; None if the run has no such variant."""

    full: str
    """FlexRoad, the full pipeline, which the others are compared with."""
    plane: str | None = None
    rgt: str | None = None
    wo_nurbs: str | None = None
    wo_ecsrc: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all variants in use."""
        names = (self.full, self.plane, self.rgt, self.wo_nurbs, self.wo_ecsrc)
        return tuple(name for name in names if name is not None)


def roles_of(config: Config) -> Roles:
    """Return the roles of a configuration's variants; FlexRoad is the first exported variant."""
    full = config.export.variants[0]
    roles: dict[str, str] = {}
    for name, chain in config.chains.items():
        role = _role(chain, config.chains[full])
        if role:
            roles.setdefault(role, name)
    return Roles(full, **roles)


def _role(chain: Chain, full: Chain) -> str:
    """Return the name of the field of `Roles` for a variant, or an empty string."""
    fit = chain["fit"].model_dump()
    if fit["method"] == "plane":
        return "plane"
    if fit["method"] == "raster" and fit["road"] == "dsm":
        return {"dsm": "rgt", "dtm": "wo_nurbs"}[fit["terrain"]]
    return "wo_ecsrc" if changes(chain, full) == {"ecsrc.method"} else ""


def changes(chain: Chain, full: Chain) -> set[str]:
    """Return the options in which a variant differs from the full pipeline, each as ``stage.option``.

    For a stage with another method, that is ``stage.method`` only: options of two methods cannot be compared.
    """
    changed = set()
    for stage, options in chain.items():
        own, other = options.model_dump(), full[stage].model_dump()
        if own.get("method") != other.get("method"):
            changed.add(f"{stage}.method")
        else:
            changed |= {f"{stage}.{key}" for key in own if own[key] != other[key]}
    return changed
