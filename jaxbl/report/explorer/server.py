"""Pages of the explorer, served to this machine's browser alone: bound to 127.0.0.1, behind a token, to no other site."""

import json
import re
import secrets
import shutil
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from jaxbl.errors import InputError, NoResult

from .folder import Source

_MOST_ASKED = 1 << 16
"""Bytes of a question."""
_LONGEST_SILENCE = 60.0
"""Seconds that a connection may say nothing, or take nothing, before it is closed."""
_MOST_VERSIONS = 3
"""Of a page that is written anew, as a study goes on; pages that are open may still read the older ones."""
_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".toml": "text/plain"}
"""Of files, by their endings; what the machine says of them may be anything."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class ExplorerServer(ThreadingHTTPServer):
    """Serves a page, and answers its questions, once `serve_forever` is called; `url` is what the browser opens.

    It is closed by `with`, which removes its pages.

    Args:
        source: results; the page is written again when it is loaded again, if there is more to come.
        port: to be bound; 0 for any that is free.

    Raises:
        InputError: the port is another program's.
    """

    daemon_threads = True

    def __init__(self, source: Source, port: int = 0):
        self.source, self._folder = source, TemporaryDirectory(prefix="jaxbl-explore-")
        self._place = Path(self._folder.name)
        self.token = secrets.token_urlsafe(24)
        self._lock, self._stale = threading.Lock(), True
        # whether a browser has loaded it, by the number of each version that was written
        self._loaded: dict[str, bool] = {}
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except OSError as error:
            raise InputError(f"--port {port}: {error.strerror}; choose another one") from None
        self.names = {f"{name}:{self.server_port}" for name in ("127.0.0.1", "localhost")}
        self.url = f"http://127.0.0.1:{self.server_port}/{self.token}/"
        threading.Thread(target=self._prepare, name="jaxbl-prepare", daemon=True).start()

    def _prepare(self) -> None:
        # what is wrong, the first answer says
        with suppress(ValueError, RuntimeError, MemoryError, NoResult):
            self.source.prepare()

    def server_close(self) -> None:
        # threads of XLA that still compute would take the interpreter down
        self.source.finish()
        super().server_close()
        # a page that is being written is written to the end, and no other one
        self._lock.acquire()
        self._folder.cleanup()

    def handle_error(self, request: Any, client_address: Any) -> None:
        # a browser that leaves a page ends what it was reading, and what sends half a request is left
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    def write_redirect(self) -> Path:
        """Write a file that only this user can read and that leads to the page: its name may be on a browser's command line,
        which everybody on the machine can see, where the token must not be."""
        path = self._place / "open.html"
        path.touch(0o600, exist_ok=False)
        leads = f'<meta http-equiv="refresh" content="0; url={self.url}">'
        path.write_text(f"<!doctype html><title>jaxbl explore</title>{leads}\n", encoding="utf-8")
        return path

    def newest(self) -> str:
        """Number of the newest version of the page, written now if the one before is out of date.

        Raises:
            InputError: the results are not there any more, or damaged.
            NoResult, OSError: the page cannot be written.
        """
        with self._lock:
            if self._stale:
                number = len(self._loaded) + 1
                folder = self._place / str(number)
                folder.mkdir()
                try:
                    self._stale = self.source.write(folder, True)
                except BaseException:
                    shutil.rmtree(folder)
                    raise
                self._loaded[folder.name] = False
                shutil.rmtree(self._place / str(number - _MOST_VERSIONS), ignore_errors=True)
            return str(len(self._loaded))

    def is_outdated(self, version: str, name: str) -> bool:
        """True if a page is loaded again while there is, or may be, a newer version of it."""
        if name != "index.html" or version not in self._loaded:
            return False
        with self._lock:
            again = self._loaded[version]
            self._loaded[version] = True
            return again and (self._stale or version != str(len(self._loaded)))

    def file(self, version: str, name: str) -> Path | None:
        """A file of a page; None if there is none."""
        files = (self._place / version).glob("*") if version in self._loaded else ()
        # names are compared, so that none leads elsewhere
        return next((file for file in files if file.name == name and file.is_file()), None)


class _Handler(BaseHTTPRequestHandler):
    server: ExplorerServer
    protocol_version = "HTTP/1.1"
    timeout = _LONGEST_SILENCE
    # head and content of an answer go together: apart, each waits for the browser's word that the other one came
    wbufsize = -1
    disable_nagle_algorithm = True
    server_version, sys_version = "jaxbl", ""

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def do_GET(self) -> None:
        if (asked := self._read_address()) is None:
            return
        if asked == ("", "") or self.server.is_outdated(*asked):
            try:
                newest = self.server.newest()
            except (InputError, NoResult, OSError) as error:
                self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
            else:
                self._send(HTTPStatus.FOUND, Location=f"{self.server.url}{newest}/index.html")
        elif file := self.server.file(*asked):
            self._send_file(file)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def do_POST(self) -> None:
        if (asked := self._read_address()) is None:
            return
        length = self.headers.get("Content-Length", "")
        answer = self.server.source.answers.get(asked[1])
        if answer is None or self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such question")
        elif not re.fullmatch(r"\d{1,9}", length) or int(length) > _MOST_ASKED:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too long a question")
        else:
            try:
                result = answer(json.loads(self.rfile.read(int(length))))
            except (ValueError, RecursionError, NoResult) as error:
                self._refuse(HTTPStatus.BAD_REQUEST, str(error))
            except (RuntimeError, MemoryError) as error:
                # of XLA, too
                self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"{type(error).__name__}: {error}")
            else:
                self._send_json(HTTPStatus.OK, result)

    def _read_address(self) -> tuple[str, str] | None:
        """Version and name of what is asked for, behind the token; None where the request was refused.

        A page of another site may ask for this address, too: it would not have the token, and its browser names it.
        """
        host = self.headers.get("Host", "")
        token, _, place = self.path.partition("?")[0].removeprefix("/").partition("/")
        if host not in self.server.names:
            # a name of another site that was pointed to this machine
            reason = "asked for by another name"
        elif self.headers.get("Origin", host).removeprefix("http://") not in self.server.names:
            reason = "asked for by another site"
        elif secrets.compare_digest(token.encode(), self.server.token.encode()):
            version, _, name = place.partition("/")
            return version, name
        else:
            reason = "open the address that jaxbl explore printed"
        self._refuse(HTTPStatus.FORBIDDEN, reason)
        return None

    def _send_file(self, file: Path) -> None:
        """A file, or the bytes of it that are asked for."""
        kind, content = _KINDS.get(file.suffix, "application/octet-stream"), np.memmap(file, mode="r")
        asked = re.fullmatch(r"bytes=(\d{1,15})-(\d{1,15})", self.headers.get("Range", ""))
        if asked is None:
            self._send(HTTPStatus.OK, content.tobytes(), Content_Type=kind)
            return
        start, last = map(int, asked.groups())
        if part := content[start : last + 1].tobytes():
            place = f"bytes {start}-{start + len(part) - 1}/{len(content)}"
            self._send(HTTPStatus.PARTIAL_CONTENT, part, Content_Type=kind, Content_Range=place)
        else:
            self._send(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, Content_Range=f"bytes */{len(content)}")

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        # what was not read of the request would be taken for the next one
        self.close_connection = True
        self._send_json(status, {"error": reason})

    def _send_json(self, status: HTTPStatus, content: Mapping[str, Any]) -> None:
        self._send(status, json.dumps(content, allow_nan=False).encode(), Content_Type="application/json")

    def _send(self, status: HTTPStatus, content: bytes = b"", **headers: str) -> None:
        """Send an answer with its headers, and those of every answer."""
        self.send_response(status)
        fixed = {
            "Content-Length": str(len(content)), "Content-Security-Policy": _POLICY, "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer", "Cache-Control": "no-store", "Cross-Origin-Resource-Policy": "same-origin",
        }  # fmt: skip
        for name, value in (headers | fixed).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(content)
