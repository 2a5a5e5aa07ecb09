"""One file per kind of input folder; each turns it into tiles."""
