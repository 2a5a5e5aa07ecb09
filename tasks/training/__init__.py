"""One file per segmenter that learns: tiles with labels -> the one file of its model."""
