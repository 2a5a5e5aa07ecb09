"""What the pipeline itself complains about: before any tile is touched, or when nobody is left to work."""


class ConfigError(Exception):
    """A configuration or run folder that cannot be used; one line naming file, key, value and remedy."""


class ClusterLost(Exception):
    """Scheduler or workers went away in mid-run and stayed away; the same command goes on from there."""
