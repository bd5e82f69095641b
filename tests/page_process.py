"""Blocks of a page, one after the other in this process: what a reader's commands import and compile is done once for all.

Reads a JSON file of `[[language, text], ...]`, and writes what each block printed, a list; of language "output", what the
last one did.
"""

import contextlib
import io
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "docs"))

from command_line import run_commands

_NAMES = {"__name__": "__main__"}  # of all Python blocks of the page


def run_block(language, text):
    """Run a block and return what it prints; a block whose language is a file's name is appended to that file."""
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    with contextlib.redirect_stdout(io.StringIO()) as output:
        if language == "python":
            exec(compile(text, "page", "exec"), _NAMES)
        elif language == "sh" and all(words[:1] in ([], ["jaxbl"]) for words in lines):
            run_commands(text)
        elif language == "sh":
            print(subprocess.run(["sh", "-e", "-c", text], stdout=subprocess.PIPE, text=True, check=True).stdout)
        else:
            with Path(language).open("a", encoding="utf-8") as file:
                file.write(text)
    return output.getvalue()


if __name__ == "__main__":
    # what a process that this one starts prints is seen on stderr
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    blocks = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    # modules are found as by `python -c`
    sys.path[0] = ""
    printed = [""]
    for language, text in blocks:
        printed.append(printed[-1] if language == "output" else run_block(language, text))
    with answer:
        json.dump(printed[1:], answer)
