"""tools/view."""
