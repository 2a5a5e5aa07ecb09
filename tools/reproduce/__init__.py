"""``flexroad tables`` and ``figures``: the paper's tables, claims and figures beside a run's results.

For researchers. Start at `tables.write_comparison` and `figures.write_figures`. `claims.py` has the rule for
the verdicts on claims. ``make reproduce`` makes the runs and calls both.
"""
