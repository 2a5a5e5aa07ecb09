"""Quality of a surface without ground truth: height source, flags, error estimate."""
