"""What comes before and after a run: one folder per tool. No module of the core imports them."""
