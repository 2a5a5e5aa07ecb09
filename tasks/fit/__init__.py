"""Surface models, one file per method: ``fit(data, clusters, options) -> Surface`` (the paper's step C)."""
