"""The command line, from the first moment on: `jaxbl` and `python -m jaxbl`."""

import os
import signal
import sys
from types import FrameType


def leave(number: int, frame: FrameType | None) -> None:
    """End at once, as foreign code that is being loaded may swallow an interrupt; but a locked folder is tidied up first."""
    if getattr(sys.modules.get("jaxbl.files"), "held_folders", ()):
        raise KeyboardInterrupt
    os.write(2, b"interrupted\n")
    os._exit(130)


# processes that a command starts load this module, too, and are ended by it
if signal.getsignal(signal.SIGINT) is signal.default_int_handler and "multiprocessing.spawn" not in sys.modules:
    signal.signal(signal.SIGINT, leave)


def program() -> None:
    """Entry point: what takes its time to load is loaded under the handler above.

    An interrupt ends the process without taking down the interpreter: threads of XLA may still compute then, and would
    crash when their memory is freed.
    """
    from .cli import INTERRUPTED, main

    try:
        main()
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(INTERRUPTED)


if __name__ == "__main__":
    program()
