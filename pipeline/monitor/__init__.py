"""Progress, tile states and alerts of a run."""
