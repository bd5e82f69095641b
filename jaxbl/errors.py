"""The one exception that means "the input is wrong": the command line turns it into one line and exit code 2."""


class InputError(ValueError):
    """Bad input. The message is one line: what, where (file, key, column, row), and what would be right."""

    def __init__(self, message: str):
        # keys, values and file names may hold line breaks
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in message))
