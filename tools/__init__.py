"""Tools before and after a run: each folder has one, with its command."""
