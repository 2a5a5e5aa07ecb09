"""What the pipeline itself complains about, before any tile is touched."""


class ConfigError(Exception):
    """A configuration or run folder that cannot be used; one line naming file, key, value and remedy."""
