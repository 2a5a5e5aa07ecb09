"""Photographs with GNSS tags: structure from motion, then dense matching."""
