"""The explorer's server: it answers this machine's browser, with the token, and no other site."""

import http.client
import json
import socket
import stat
import threading
from pathlib import Path

import pytest

from jaxbl.errors import InputError
from jaxbl.report.explorer.folder import Source
from jaxbl.report.explorer.server import ExplorerServer


def write_page(out: Path, served: bool) -> bool:
    (out / "index.html").write_text("<p>page</p>")
    (out / "points.parquet").write_bytes(bytes(range(100)))
    return False


def answer(question):
    if question == {"at": 2}:
        raise RuntimeError("out of memory")
    if question != {"at": 1}:
        raise InputError("at: should be 1")
    return {"value": 2.0}


@pytest.fixture
def server():
    with ExplorerServer(Source("", [], write_page, {"run": answer}, lambda: None, lambda: None)) as explorer:
        threading.Thread(target=explorer.serve_forever, daemon=True).start()
        yield explorer
        explorer.shutdown()


def request_path(server, path, method="GET", body=None, **headers):
    """Status, headers and content of an answer; `path` behind the token, or whole from "/"."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port)
    token = server.url.split("/")[3]
    http_headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path if path.startswith("/") else f"/{token}/{path}", body, http_headers)
    response = connection.getresponse()
    reply = response.status, response.headers, response.read()
    connection.close()
    return reply


def test_the_page_and_parts_of_its_files(server):
    status, headers, _ = request_path(server, "")
    assert status == 302 and headers["Location"] == f"{server.url}1/index.html"
    status, headers, content = request_path(server, "1/index.html")
    assert (status, headers["Content-Type"], content) == (200, "text/html", b"<p>page</p>")
    assert "script-src 'self'" in headers["Content-Security-Policy"] and headers["Referrer-Policy"] == "no-referrer"
    status, headers, content = request_path(server, "1/points.parquet", Range="bytes=10-19")
    assert (status, headers["Content-Range"], content) == (206, "bytes 10-19/100", bytes(range(10, 20)))
    assert request_path(server, "1/points.parquet", Range="bytes=90-900")[2] == bytes(range(90, 100))
    assert request_path(server, "1/points.parquet", Range="bytes=100-120")[0] == 416
    assert len(request_path(server, "1/points.parquet")[2]) == 100


@pytest.mark.parametrize(
    "path", ["1/../server.py", "1/%2e%2e/x", "2/index.html", "1/", "1", "x/index.html", "1/points.parquet/x"]
)
def test_nothing_else_is_read(server, path):
    request_path(server, "")
    assert request_path(server, path)[0] == 404


def test_only_this_machine_with_the_token(server):
    assert server.server_address[0] == "127.0.0.1"
    request_path(server, "")
    address = f"127.0.0.1:{server.server_port}"
    for path in ("/", "/1/index.html", "/wrong/1/index.html", "/%ff/"):
        status, _, content = request_path(server, path)
        assert status == 403 and json.loads(content) == {"error": "open the address that jaxbl explore printed"}
    assert request_path(server, "1/index.html", Host="evil.example")[0] == 403
    assert request_path(server, "1/index.html", Origin="http://evil.example")[0] == 403
    assert request_path(server, "1/index.html", Origin="null")[0] == 403
    assert request_path(server, "1/index.html", Origin=f"https://{address}")[0] == 403
    assert request_path(server, "1/index.html", Origin=f"http://{address}")[0] == 200


def test_questions(server):
    kind = {"Content_Type": "application/json"}
    assert request_path(server, "1/run", "POST", '{"at": 1}', **kind)[::2] == (200, b'{"value": 2.0}')
    for body, reason in (
        ('{"at": 3}', "at: should be 1"),
        ("{", "Expecting property name"),
        (b"\xff", "codec can't decode"),
    ):
        status, _, content = request_path(server, "1/run", "POST", body, **kind)
        assert status == 400 and reason in json.loads(content)["error"]
    status, _, content = request_path(server, "1/run", "POST", '{"at": 2}', **kind)
    assert status == 500 and json.loads(content) == {"error": "RuntimeError: out of memory"}
    assert request_path(server, "1/run", "POST", '{"at": 1}')[0] == 404
    assert request_path(server, "1/other", "POST", '{"at": 1}', **kind)[0] == 404
    assert request_path(server, "1/run", "POST", "[" * 70_000, **kind)[0] == 413
    assert request_path(server, "1/run", "POST", '{"at": 1}', Origin="http://evil.example", **kind)[0] == 403


def test_what_no_browser_asks_is_refused_without_a_traceback(server, capfd):
    request_path(server, "")
    kind = {"Content_Type": "application/json"}
    assert request_path(server, "1/run", "POST", "[" * 60_000, **kind)[0] == 400
    assert request_path(server, "1/run", "POST", "", Content_Length="9" * 5000, **kind)[0] == 413
    assert request_path(server, "1/points.parquet", Range=f"bytes=0-{'9' * 5000}")[0] == 200
    assert request_path(server, f"{'1' * 5000}/index.html")[0] == 404
    assert request_path(server, "/" + "x" * 70_000)[0] == 414
    assert request_path(server, "1/index.html", "HEAD")[0] == request_path(server, "1/index.html", "OPTIONS")[0] == 501
    assert capfd.readouterr().err == ""


def test_a_page_that_is_left_while_it_is_read_says_nothing(capfd, monkeypatch):
    def write(out, served):
        (out / "index.html").write_bytes(bytes(1 << 25))
        return False

    with ExplorerServer(Source("", [], write, {}, lambda: None, lambda: None)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        server.newest()
        address = f"127.0.0.1:{server.server_port}"
        request = f"GET {server.url.partition(address)[2]}1/index.html HTTP/1.1\r\nHost: {address}\r\n\r\n"
        ended, close = threading.Event(), server.shutdown_request
        monkeypatch.setattr(server, "shutdown_request", lambda request: (close(request), ended.set()))
        with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
            connection.sendall(request.encode())
            assert connection.recv(100).startswith(b"HTTP/1.1 200")
        assert ended.wait(10.0)
        server.shutdown()
    assert capfd.readouterr().err == ""


def test_a_connection_that_says_nothing_is_closed(server, capfd, monkeypatch):
    """Before a request, within its head, and within its body."""
    monkeypatch.setattr("jaxbl.report.explorer.server._Handler.timeout", 0.2)
    host = f"Host: 127.0.0.1:{server.server_port}"
    token, kind = server.url.split("/")[3], "Content-Type: application/json"
    for start in ("", "GET / HTT", f"POST /{token}/1/run HTTP/1.1\r\n{host}\r\n{kind}\r\nContent-Length: 9\r\n\r\n{{"):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=10.0) as connection:
            connection.sendall(start.encode())
            assert connection.recv(100) == b""
    assert capfd.readouterr().err == ""


def test_the_token_is_not_in_what_a_browser_is_started_with(server):
    path = server.write_redirect()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600 and server.token not in str(path)
    assert f"url={server.url}" in path.read_text()
    # nor is the file itself served
    assert request_path(server, "1/open.html")[0] == 404


def test_a_page_loaded_again_is_the_newest():
    left = [True, True, False]

    def write(out, served):
        (out / "index.html").write_text(str(len(left)))
        return left.pop(0)

    with ExplorerServer(Source("", [], write, {}, lambda: None, lambda: None)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert request_path(server, "")[1]["Location"] == f"{server.url}1/index.html"
        assert request_path(server, "1/index.html")[2] == b"3"
        # by the browser's button, which asks for this version
        status, headers, _ = request_path(server, "1/index.html")
        assert (status, headers["Location"]) == (302, f"{server.url}2/index.html")
        assert request_path(server, "2/index.html")[2] == b"2"
        assert request_path(server, "2/index.html")[1]["Location"] == f"{server.url}3/index.html"
        # nothing is to come: it stays
        assert request_path(server, "3/index.html")[2] == request_path(server, "3/index.html")[2] == b"1"
        assert request_path(server, "1/index.html")[1]["Location"] == f"{server.url}3/index.html"
        server.shutdown()


def test_results_that_cannot_be_read_are_told_and_read_later():
    errors = [InputError("study.toml: is missing"), OSError("no space left")]

    def write(out, served):
        (out / "index.html").write_text("page")
        if errors:
            raise errors.pop(0)
        return False

    with ExplorerServer(Source("", [], write, {}, lambda: None, lambda: None)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for name in ("study.toml: is missing", "no space left"):
            status, _, content = request_path(server, "")
            assert (status, json.loads(content)) == (503, {"error": name})
        assert request_path(server, "")[0] == 302
        server.shutdown()


def test_a_port_of_another_program(server):
    source = Source("", [], write_page, {}, lambda: None, lambda: None)
    with (
        pytest.raises(InputError, match=f"--port {server.server_port}: .*; choose another one"),
        ExplorerServer(source, server.server_port),
    ):
        pass
