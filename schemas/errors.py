"""One family of errors: what went wrong, where, and what to do next."""

from __future__ import annotations

EXIT_OK = 0
EXIT_INTERNAL = 1
EXIT_USAGE = 2
EXIT_SOME_FAILED = 3
EXIT_INVALID_INPUT = 4
EXIT_REGRESSION = 5
EXIT_INTERRUPTED = 130


class ScanloomError(Exception):
    """Base of every error a user may meet.

    Parameters
    ----------
    what : one sentence that says what went wrong.
    where : the file, session, chunk or stamp it concerns; empty when there is none.
    next_step : what the user can do about it; empty when nothing sensible is known.
    """

    exit_code = EXIT_INTERNAL

    def __init__(self, what: str, *, where: str = "", next_step: str = "") -> None:
        super().__init__(what, where, next_step)
        self.what = what
        self.where = where
        self.next_step = next_step

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        advice = f" Next: {self.next_step}" if self.next_step else ""
        return f"{place}{self.what}{advice}"

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.what, self.where, self.next_step)


def _rebuild(kind: type[ScanloomError], what: str, where: str, next_step: str) -> ScanloomError:
    return kind(what, where=where, next_step=next_step)


class InvalidInput(ScanloomError):
    """The log or file given by the user cannot be used."""

    exit_code = EXIT_INVALID_INPUT


class UsageError(ScanloomError):
    """The command line or a settings file asks for something that does not exist."""

    exit_code = EXIT_USAGE


class ProductError(ScanloomError):
    """A product does not fit its declaration, or its file is damaged."""


class StageError(ScanloomError):
    """A stage cannot do its job on the input it was given."""


class StoreError(ScanloomError):
    """The artifact store cannot be read or written."""
