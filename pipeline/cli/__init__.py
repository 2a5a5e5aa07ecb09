"""``flexroad ...``: the command line."""
