"""The one base of what this package complains about."""

from __future__ import annotations


class TaskError(Exception):
    """A stage that cannot do its work on a tile; one line with the value and the remedy.

    Parameters
    ----------
    message : str
        One line.
    file : str, optional
        The source file at fault, for the table of failures.
    """

    def __init__(self, message: str, file: str = "") -> None:
        super().__init__(message)
        self.file = file

    def __reduce__(self) -> tuple[type[TaskError], tuple[str, str]]:
        return type(self), (str(self), self.file)
