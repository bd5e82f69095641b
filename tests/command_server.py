"""Commands in processes that begin with everything loaded: forks of one process that has imported the package, and has
computed nothing. They draw one figure of each kind, as the tests do.

A new interpreter takes seconds to import JAX and the package. What a test says of that start itself needs one all the same:
times of imports, modules that are not loaded, an interrupt while they are.
"""

import atexit
import functools
import gc
import importlib
import json
import multiprocessing.process
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import types
from pathlib import Path

LATE_MODULES = (
    "jaxbl.__main__",
    "jaxbl.cli",
    "jaxbl.datasheet",
    "pyarrow.dataset",
    "pyarrow.pandas_compat",
    "PIL.Image",
)
"""Modules that commands import late, beside those of the public names."""

_READY = b"ready"
_MESSAGE = 2**17
"""Bytes of the largest request: arguments and environment."""


class Process:
    """A command that runs, as of :class:`subprocess.Popen`: its output in pipes, as text."""

    def __init__(self, arguments, cwd, environment):
        ends = [os.pipe() for _ in range(3)]
        files = [os.open(os.devnull, os.O_RDONLY), *(write for _, write in ends)]
        request = {"arguments": arguments, "cwd": str(cwd), "environment": environment}
        socket.send_fds(_server(), [json.dumps(request).encode()], files)
        for file in files:
            os.close(file)
        self.stdout, self.stderr, self._status = (os.fdopen(read, encoding="utf-8") for read, _ in ends)
        self.pid = int(self._status.readline())
        self.returncode = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.wait()
        self.stdout.close()
        self.stderr.close()

    def poll(self):
        if self.returncode is None and select.select([self._status], [], [], 0.0)[0]:
            self.wait()
        return self.returncode

    def wait(self):
        if self.returncode is None:
            self.returncode = int(self._status.readline())
            self._status.close()
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout=300.0):
        """Return the rest of stdout and of stderr; kill a command that does not end."""
        errors = []
        reader = threading.Thread(target=lambda: errors.append(self.stderr.read()))
        killer = threading.Timer(timeout, self.kill)
        reader.start()
        killer.start()
        output = self.stdout.read()
        reader.join()
        self.wait()
        killer.cancel()
        return output, *errors


def start_command(*arguments, cwd, **environment):
    """`jaxbl` with these arguments, in a folder, with more environment variables."""
    return Process(["-m", "jaxbl", *map(str, arguments)], cwd, os.environ | environment)


def run_command(*arguments, cwd, **environment):
    """Run `jaxbl` with these arguments to its end: `returncode`, `stdout` and `stderr`."""
    return run_python("-m", "jaxbl", *arguments, cwd=cwd, **environment)


def run_python(*arguments, cwd, timeout=300.0, **environment):
    """Run what `python` runs with these arguments, `-m MODULE`, `-c CODE` or a file. A `PYTHONPATH` that differs is searched
    first, and the package is then imported anew, with what is installed there."""
    arguments = list(map(str, arguments))
    with Process(arguments, cwd, os.environ | environment) as process:
        output, errors = process.communicate(timeout)
    return subprocess.CompletedProcess(arguments, process.returncode, output, errors)


# the other side


@functools.cache
def _server():
    """The connection to this process's server, which ends when it is closed."""
    client_socket, server_socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    call = [sys.executable, __file__, str(server_socket.fileno())]
    # one thread of BLAS: matrices are small
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(_paths())}
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            call,
            env=environment,
            pass_fds=[server_socket.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
        )
        server_socket.close()
        ready = client_socket.recv(_MESSAGE)
        errors.seek(0)
        # a user would read what an import says at each command
        assert (ready, errors.read().decode()) == (_READY, "")

    def end():
        # forks of this process may hold the connection, too
        client_socket.shutdown(socket.SHUT_RDWR)
        process.wait()

    atexit.register(end)
    return client_socket


def _paths():
    root = str(Path(__file__).parents[1])
    return [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]


def _serve(connection):
    """Fork for each request; in the fork return what it asks for."""
    waiting = {}
    awake, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection.send(_READY)
    while True:
        ready, _, _ = select.select([connection, awake], [], [])
        if awake in ready:
            os.read(awake, _MESSAGE)
            for pid in list(waiting):
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    with os.fdopen(waiting.pop(pid), "w") as file:
                        file.write(f"{os.waitstatus_to_exitcode(status)}\n")
        if connection in ready:
            message, files, _, _ = socket.recv_fds(connection, _MESSAGE, 4)
            if not message:
                sys.exit()
            pid = os.fork()
            if pid == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                signal.signal(signal.SIGINT, signal.default_int_handler)
                for number, file in enumerate(files[:3]):
                    os.dup2(file, number)
                for file in [*files, *waiting.values(), awake, wake, connection.detach()]:
                    os.close(file)
                return json.loads(message)
            waiting[pid] = files.pop()
            os.write(waiting[pid], f"{pid}\n".encode())
            for file in files:
                os.close(file)


def _load():
    """Import what commands import; nothing may be computed, as the threads of a backend do not outlive a fork."""
    package = importlib.import_module("jaxbl")
    for name in dir(package):
        getattr(package, name)
    for name in LATE_MODULES:
        importlib.import_module(name)
    importlib.import_module("figure_kinds").draw_figures_by_kind()
    assert not importlib.import_module("jax._src.xla_bridge").backends_are_initialized()
    gc.collect()
    gc.freeze()


def _execute(arguments, cwd, environment):
    """Become what `python` would be with these arguments."""
    os.chdir(cwd)
    # a process that this one spawns searches modules there
    multiprocessing.process.ORIGINAL_DIR = cwd
    os.environ.clear()
    os.environ.update(environment)
    sys.stdout.reconfigure(write_through=bool(environment.get("PYTHONUNBUFFERED")))
    # commands look whether they were started by another process of theirs
    sys.modules.pop("multiprocessing.spawn", None)
    # it is run anew below, with its handler of interrupts
    sys.modules.pop("jaxbl.__main__", None)
    new = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path and path not in sys.path]
    if new:
        sys.path[1:1] = new
        for path in new:
            if (file := Path(path, "sitecustomize.py")).is_file():
                runpy.run_path(str(file))
        for name in [name for name in sys.modules if name.partition(".")[0] == "jaxbl"]:
            del sys.modules[name]
    kind, *words = arguments
    if kind == "-m":
        sys.path[0], sys.argv = cwd, words
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    elif kind == "-c":
        sys.path[0], sys.argv = "", ["-c", *words[1:]]
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(compile(words[0], "<string>", "exec"), vars(main))
    else:
        sys.path[0], sys.argv = str(Path(kind).parent), arguments
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    _load()
    _execute(**_serve(socket.socket(fileno=int(sys.argv[1]))))
