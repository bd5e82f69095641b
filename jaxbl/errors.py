"""The one exception that means "the input is wrong": the command line turns it into one line and exit code 2."""


class InputError(ValueError):
    """Bad input. The message is one line: what, where (file, key, column, row), and what would be right."""
