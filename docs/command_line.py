"""Commands of jaxbl in this process: pages have many, which import and compile once for all.

The kernel of the tutorials begins with this file (`PYTHONSTARTUP`): there, `%%sh` runs its lines so.
"""

import io
import shlex
import sys
from contextlib import redirect_stdout


def run_commands(text: str) -> None:
    """Run lines of `jaxbl`; an error ends the process, or the cell, as it ends the command."""
    from jaxbl.__main__ import program

    for line in text.splitlines():
        if words := shlex.split(line, comments=True):
            sys.argv = words
            try:
                program()
            except SystemExit as end:
                if end.code:
                    raise


def run_cell(line: str, cell: str) -> None:
    """Print what the commands of a cell print without the colours that they give a kernel's output."""
    with redirect_stdout(io.StringIO()) as printed:
        run_commands(cell)
    print(printed.getvalue(), end="")


if __name__ == "__main__":
    from IPython import get_ipython

    get_ipython().register_magic_function(run_cell, "cell", "sh")
