"""The report as one HTML page: a map first, then what to look at, with the tables folded away."""
