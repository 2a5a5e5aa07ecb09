"""Segment roads by a frozen DINOv2 and a trained head, as in the paper."""
