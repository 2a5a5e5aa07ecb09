"""Configurations: one set of options per stage, and variants of them."""
