"""``flexroad init`` and ``catalog check``: the content of a folder or a catalog, and expected failures.

For users who have downloads and look for the right command, or check a catalog before a long run. Start at
`command.py`: `init` calls `downloads.look`, and `catalog check` calls `catalog.check`.
"""
