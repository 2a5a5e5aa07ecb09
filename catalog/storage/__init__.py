"""Where files are: paths on disk and in object storage, and atomic writes."""
