"""Commands of jaxbl in this process: pages have many, which import and compile once for all.

The kernel of the tutorials begins with this file (`PYTHONSTARTUP`): there, `%%sh` runs its lines so.
"""

import shlex
import sys


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


if __name__ == "__main__":
    from IPython import get_ipython

    get_ipython().register_magic_function(lambda line, cell: run_commands(cell), "cell", "sh")
