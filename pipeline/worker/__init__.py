"""What one worker does: bring one tile up to date."""
