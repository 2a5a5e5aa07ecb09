"""The one base of what this package complains about."""


class CatalogError(Exception):
    """A catalog, source folder or tile that cannot be used; one line naming file, value and remedy."""
