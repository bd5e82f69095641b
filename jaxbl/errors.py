"""The two exceptions that the command line prints as one line: wrong input (exit code 2), and no result (exit code 1)."""

_MESSAGE_LENGTH = 2000
"""Most characters of a message: a screen of text. A longer one repeats a user's file back to its author."""


def escape_unprintable(text: str) -> str:
    """Return text of any origin as one line for a terminal, with line breaks and escape sequences spelt out."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class _OneLineError(Exception):
    def __init__(self, message: str):
        # keys, values and file names may hold line breaks, and be of any length
        super().__init__(escape_unprintable(shorten(message, _MESSAGE_LENGTH)))


class InputError(_OneLineError, ValueError):
    """Bad input. The message is one line: what, where (file, key, column, row), and what would be right."""


class NoResult(_OneLineError, RuntimeError):
    """The input is valid, but there is no answer to give. The message is one line: what fails, where, by how much."""


def shorten(text: str, limit: int) -> str:
    """Return a text of at most `limit` characters; a longer one keeps its first and its last half."""
    if len(text) <= limit:
        return text
    half = (limit - 3) // 2
    return f"{text[: limit - 3 - half]}...{text[len(text) - half :]}"
