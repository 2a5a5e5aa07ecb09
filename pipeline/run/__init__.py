"""A run: its folder, its loop over the tiles, its lock, its event log and its status."""
