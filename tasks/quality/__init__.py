"""Quality of a surface without ground truth: support, flags, error estimate."""
