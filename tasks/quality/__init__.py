"""Figures that need no ground truth: support, flags, error estimate."""
