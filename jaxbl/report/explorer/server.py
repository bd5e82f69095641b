"""Pages of the explorer, served to this machine's browser alone: bound to 127.0.0.1, behind a token, to no other site."""

import json
import re
import secrets
import shutil
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

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


@contextmanager
def start_server(source: Source, port: int = 0) -> "Iterator[ExplorerServer]":
    """A server for results, which waits for `serve_forever`; its pages are removed at the end.

    Raises:
        InputError: the port is another program's.
    """
    with TemporaryDirectory(prefix="jaxbl-explore-") as place:
        try:
            server = ExplorerServer(source, Path(place), port)
        except OSError as error:
            raise InputError(f"--port {port}: {error.strerror}; choose another one") from None
        with server:
            threading.Thread(target=_prepare, args=(source,), name="jaxbl-prepare", daemon=True).start()
            try:
                yield server
            finally:
                # threads of XLA that still compute would take the interpreter down
                source.finish()


def _prepare(source: Source) -> None:
    # what is wrong, the first answer says
    with suppress(ValueError, RuntimeError, MemoryError, NoResult):
        source.prepare()


class ExplorerServer(ThreadingHTTPServer):
    """Serves a page and answers its questions; `url` is what the browser opens.

    Args:
        source: results; the page is written again when it is loaded again, if there is more to come.
        place: a folder for pages, which the caller removes.
        port: to be bound; 0 for any that is free.

    Raises:
        OSError: the port cannot be bound.
    """

    daemon_threads = True

    def __init__(self, source: Source, place: Path, port: int):
        self.source, self._place = source, place
        self.token = secrets.token_urlsafe(24)
        self._lock, self._stale = threading.Lock(), True
        # the number of its versions, and which of these a browser has loaded
        self._versions, self._loaded = 0, set()
        super().__init__(("127.0.0.1", port), _Handler)
        self.names = {f"{name}:{self.server_port}" for name in ("127.0.0.1", "localhost")}
        self.url = f"http://127.0.0.1:{self.server_port}/{self.token}/"

    def server_close(self) -> None:
        super().server_close()
        # a page that is being written is written to the end, and no other one
        self._lock.acquire()

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
                folder = self._place / str(self._versions + 1)
                folder.mkdir()
                try:
                    self._stale = self.source.write(folder, True)
                except BaseException:
                    shutil.rmtree(folder)
                    raise
                self._versions += 1
                shutil.rmtree(self._place / str(self._versions - _MOST_VERSIONS), ignore_errors=True)
            return str(self._versions)

    def is_outdated(self, version: str, name: str) -> bool:
        """True if a page is loaded again while there is, or may be, a newer version of it."""
        if name != "index.html":
            return False
        with self._lock:
            again = version in self._loaded
            self._loaded |= {version} & self._list_versions()
            return again and (self._stale or version != str(self._versions))

    def file(self, version: str, name: str) -> Path | None:
        """A file of a page; None if there is none."""
        files = (self._place / version).glob("*") if version in self._list_versions() else ()
        # names are compared, so that none leads elsewhere
        return next((file for file in files if file.name == name and file.is_file()), None)

    def _list_versions(self) -> set[str]:
        """Numbers of the versions that were written, as text."""
        return {*map(str, range(1, self._versions + 1))}


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
        if (parts := self._parts()) is None:
            return
        if parts in ([], [""]) or (len(parts) == 2 and self.server.is_outdated(*parts)):
            try:
                newest = self.server.newest()
            except (InputError, NoResult, OSError) as error:
                self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
            else:
                self._send(HTTPStatus.FOUND, headers={"Location": f"{self.server.url}{newest}/index.html"})
            return
        file = self.server.file(*parts) if len(parts) == 2 else None
        if file is None:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")
        else:
            self._send_file(file)

    def do_POST(self) -> None:
        if (parts := self._parts()) is None:
            return
        length = self.headers.get("Content-Length", "")
        answer = self.server.source.answers.get(parts[-1]) if len(parts) == 2 else None
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
                self._send(HTTPStatus.OK, json.dumps(result, allow_nan=False).encode(), "application/json")

    def _parts(self) -> list[str] | None:
        """The address behind the token; None where the request was refused.

        A page of another site may ask for this address, too: it would not have the token, and its browser names it.
        """
        origin = self.headers.get("Origin")
        if self.headers.get("Host") not in self.server.names:
            # a name of another site that was pointed to this machine
            self._refuse(HTTPStatus.FORBIDDEN, "asked for by another name")
        elif origin is not None and origin.removeprefix("http://") not in self.server.names:
            self._refuse(HTTPStatus.FORBIDDEN, "asked for by another site")
        else:
            token, *parts = self.path.partition("?")[0].removeprefix("/").split("/")
            if secrets.compare_digest(token.encode(), self.server.token.encode()):
                return parts
            self._refuse(HTTPStatus.FORBIDDEN, "open the address that jaxbl explore printed")
        return None

    def _send_file(self, file: Path) -> None:
        """A file, or the bytes of it that are asked for."""
        kind = _KINDS.get(file.suffix, "application/octet-stream")
        size = file.stat().st_size
        asked = re.fullmatch(r"bytes=(\d{1,15})-(\d{1,15})", self.headers.get("Range", ""))
        start, end = (int(asked[1]), min(int(asked[2]) + 1, size)) if asked else (0, size)
        if start >= end:
            self._send(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, headers={"Content-Range": f"bytes */{size}"})
            return
        with file.open("rb") as content:
            content.seek(start)
            part = content.read(end - start)
        if asked:
            self._send(HTTPStatus.PARTIAL_CONTENT, part, kind, {"Content-Range": f"bytes {start}-{end - 1}/{size}"})
        else:
            self._send(HTTPStatus.OK, part, kind)

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        # what was not read of the request would be taken for the next one
        self.close_connection = True
        self._send(status, json.dumps({"error": reason}).encode(), "application/json")

    def _send(self, status: HTTPStatus, content: bytes = b"", kind: str = "", headers: Mapping[str, str] = {}) -> None:
        self.send_response(status)
        content_type = {"Content-Type": kind} if kind else {}
        fixed = {
            "Content-Length": str(len(content)), "Content-Security-Policy": _POLICY, "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer", "Cache-Control": "no-store", "Cross-Origin-Resource-Policy": "same-origin",
        }  # fmt: skip
        for name, value in (content_type | fixed | dict(headers)).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
