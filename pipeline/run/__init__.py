"""A run: its record, its tiles, its lock and its log."""
