"""``flexroad init`` and ``catalog check``: what a folder or a catalog has, and what would fail.

For who has downloads and wants the right command, or a catalog before a long run. Start at `command.py`:
`init` calls `downloads.look`, and `catalog check` calls `catalog.check`.
"""
