"""The paper's tables, claims and figures beside a run's."""
