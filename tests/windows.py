"""Commands without what Windows has not: modules, functions of `os` and `signal` are taken from the package alone."""

import builtins
import importlib
import os
import signal
import sys
from types import ModuleType

MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty", "posix"}
_OS = """
chown chroot confstr copy_file_range ctermid fchdir fchown fdatasync fork forkpty fpathconf fstatvfs getegid geteuid
getgid getgroups getloadavg getpgid getpgrp getpriority getsid getuid getxattr initgroups killpg lchown lockf major
memfd_create minor mkfifo mknod nice openpty pathconf pidfd_open pipe2 posix_fadvise posix_fallocate posix_spawn pread
pwrite readv register_at_fork sched_getaffinity sched_setaffinity sched_yield sendfile setegid seteuid setgid setpgid
setpriority setsid setuid statvfs sync sysconf tcgetpgrp ttyname uname wait wait3 wait4 waitid writev O_NOFOLLOW
O_NONBLOCK O_DIRECTORY O_CLOEXEC O_SYNC WNOHANG
"""
_SIGNAL = """
SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGTSTP SIGUSR1 SIGUSR2 SIG_BLOCK SIG_SETMASK
SIG_UNBLOCK alarm getitimer pause pthread_kill pthread_sigmask setitimer siginterrupt sigpending sigtimedwait sigwait
sigwaitinfo
"""
NAMES = {"os": set(_OS.split()), "signal": set(_SIGNAL.split())}


class OnWindows(ModuleType):
    """A module without the names that it has on POSIX alone."""

    def __init__(self, module):
        super().__init__(module.__name__)
        self._module = module

    def __getattr__(self, name):
        if name in NAMES[self.__name__]:
            raise AttributeError(f"{self.__name__}.{name} is not there on Windows")
        return getattr(self._module, name)


class WindowsOs(OnWindows):
    """`os` on Windows."""

    name = "nt"

    def kill(self, pid, number):
        """Refuse all that would end the process there."""
        raise AssertionError(f"os.kill({pid}, {number}) ends a process on Windows")


class Msvcrt(ModuleType):
    """Locks of bytes, as by the system of Windows: for each open file."""

    LK_NBLCK = 2

    def locking(self, number, mode, length):
        """Lock bytes from the place of the file on, or raise `OSError` at once."""
        fcntl = importlib.import_module("fcntl")
        fcntl.lockf(number, fcntl.LOCK_EX | fcntl.LOCK_NB, length, os.lseek(number, 0, os.SEEK_CUR))


def import_as_on_windows(name, globals=None, locals=None, fromlist=(), level=0, *, original=builtins.__import__):
    """Import for the package what Windows has, and for others what there is."""
    if level == 0 and (globals or {}).get("__name__", "").partition(".")[0] == "jaxbl":
        if name.partition(".")[0] in MODULES:
            raise ModuleNotFoundError(f"No module named '{name}' on Windows")
        if name in SEEN:
            return SEEN[name]
    return original(name, globals, locals, fromlist, level)


SEEN = {"os": WindowsOs(os), "signal": OnWindows(signal), "msvcrt": Msvcrt("msvcrt")}


if __name__ == "__main__":
    builtins.__import__ = import_as_on_windows
    for words in sys.argv[1:]:
        sys.argv = ["jaxbl", *words.split()]
        try:
            importlib.import_module("jaxbl.cli").main()
        except SystemExit as end:
            if end.code:
                raise
