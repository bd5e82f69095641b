"""Exceptions that the command line turns into one line: wrong input (exit 2), and no result to give (exit 1)."""


class InputError(ValueError):
    """Bad input. The message is one line: what, where (file, key, column, row), and what would be right."""

    def __init__(self, message: str):
        # keys, values and file names may hold line breaks
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in message))


class NoResult(RuntimeError):
    """The input is valid, but there is no answer to give. The message is one line: what fails, where, by how much."""
