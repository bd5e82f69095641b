"""What a command in a pipe says on stderr while it works, when that takes longer than ten seconds."""

import re

_LINE = re.compile(
    r"jaxbl: [^:]+, ((step \d+ of \d+, )?for [\d.]+ \w+ so far|\d+ of \d+ \w+ \(\d+ %\)(, about [\d.]+ \w+ left)?)\n"
)


def without_progress(stderr):
    """Return the text without lines of progress."""
    return "".join(line for line in stderr.splitlines(keepends=True) if not _LINE.fullmatch(line))
