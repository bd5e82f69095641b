"""Exceptions that the command line turns into one line: wrong input (exit 2), and no result to give (exit 1)."""

_LONGEST = 2000
"""Characters of a message: a screen of text; what is longer repeats a file back to its author."""


def printable(text: str) -> str:
    """Text of any origin as one line for a terminal: line breaks, escape sequences and the like are spelt out."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class InputError(ValueError):
    """Bad input. The message is one line: what, where (file, key, column, row), and what would be right."""

    def __init__(self, message: str):
        # keys, values and file names may hold line breaks, and be of any length
        super().__init__(printable(shortened(message, _LONGEST)))


class NoResult(RuntimeError):
    """The input is valid, but there is no answer to give. The message is one line: what fails, where, by how much."""

    def __init__(self, message: str):
        super().__init__(printable(shortened(message, _LONGEST)))


def shortened(text: str, most: int) -> str:
    """Text of at most so many characters: its begin and its end, if it is longer."""
    if len(text) <= most:
        return text
    half = (most - 3) // 2
    return f"{text[: most - 3 - half]}...{text[len(text) - half :]}"
