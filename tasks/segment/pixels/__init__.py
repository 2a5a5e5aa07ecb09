"""Segment roads by gradient-boosted trees over per-pixel features."""
