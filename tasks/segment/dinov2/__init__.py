"""Segment roads by DINOv2, as in the paper; here it is frozen and has a trained head."""
