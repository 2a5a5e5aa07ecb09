"""The base class of this package's errors."""


class CatalogError(Exception):
    """A catalog, source folder or tile that cannot be used; one line with file, value and remedy."""
