"""The paper's tables, claims and figures, with a run's results beside them."""
