"""Errors of the pipeline itself: raised before any tile is processed, or when the cluster is lost."""


class ConfigError(Exception):
    """An unusable configuration or run folder; the message is one line with file, key, value and remedy."""


class ClusterLost(Exception):
    """Scheduler or workers were lost during a run; the same command resumes the run."""
