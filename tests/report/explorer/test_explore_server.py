"""The explorer's server: it answers this machine's browser, with the token, and no other site."""

import http.client
import json
import threading
from pathlib import Path

import pytest

from jaxbl.errors import InputError
from jaxbl.report.explorer.folder import Source
from jaxbl.report.explorer.server import served


def write(out: Path, served: bool) -> bool:
    (out / "index.html").write_text("<p>page</p>")
    (out / "points.parquet").write_bytes(bytes(range(100)))
    return False


def ask(asked):
    if asked != {"at": 1}:
        raise InputError("at: should be 1")
    return {"value": 2.0}


@pytest.fixture
def server():
    with served(Source([], write, {"run": ask}, lambda: None)) as one:
        threading.Thread(target=one.serve_forever, daemon=True).start()
        yield one
        one.shutdown()


def call(server, path, method="GET", body=None, **headers):
    """Status, headers and content of an answer; `path` behind the token, or whole from "/"."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port)
    token = server.url.split("/")[3]
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path if path.startswith("/") else f"/{token}/{path}", body, named)
    answer = connection.getresponse()
    found = answer.status, answer.headers, answer.read()
    connection.close()
    return found


def test_the_page_and_parts_of_its_files(server):
    status, headers, _ = call(server, "")
    assert status == 302 and headers["Location"] == f"{server.url}1/index.html"
    status, headers, content = call(server, "1/index.html")
    assert (status, headers["Content-Type"], content) == (200, "text/html", b"<p>page</p>")
    assert "script-src 'self'" in headers["Content-Security-Policy"] and headers["Referrer-Policy"] == "no-referrer"
    status, headers, content = call(server, "1/points.parquet", Range="bytes=10-19")
    assert (status, headers["Content-Range"], content) == (206, "bytes 10-19/100", bytes(range(10, 20)))
    assert call(server, "1/points.parquet", Range="bytes=90-900")[2] == bytes(range(90, 100))
    assert call(server, "1/points.parquet", Range="bytes=100-120")[0] == 416
    assert len(call(server, "1/points.parquet")[2]) == 100


@pytest.mark.parametrize(
    "path", ["1/../server.py", "1/%2e%2e/x", "2/index.html", "1/", "1", "x/index.html", "1/points.parquet/x"]
)
def test_nothing_else_is_read(server, path):
    call(server, "")
    assert call(server, path)[0] == 404


def test_only_this_machine_with_the_token(server):
    assert server.server_address[0] == "127.0.0.1"
    call(server, "")
    own = f"127.0.0.1:{server.server_port}"
    for path in ("/", "/1/index.html", "/wrong/1/index.html", "/%ff/"):
        status, _, content = call(server, path)
        assert status == 403 and json.loads(content) == {"error": "open the address that jaxbl explore printed"}
    assert call(server, "1/index.html", Host="evil.example")[0] == 403
    assert call(server, "1/index.html", Origin="http://evil.example")[0] == 403
    assert call(server, "1/index.html", Origin="null")[0] == 403
    assert call(server, "1/index.html", Origin=f"https://{own}")[0] == 403
    assert call(server, "1/index.html", Origin=f"http://{own}")[0] == 200


def test_questions(server):
    kind = {"Content_Type": "application/json"}
    assert call(server, "1/run", "POST", '{"at": 1}', **kind)[::2] == (200, b'{"value": 2.0}')
    for body, why in (('{"at": 3}', "at: should be 1"), ("{", "Expecting property name"), (b"\xff", "codec can't decode")):
        status, _, content = call(server, "1/run", "POST", body, **kind)
        assert status == 400 and why in json.loads(content)["error"]
    assert call(server, "1/run", "POST", '{"at": 1}')[0] == 404
    assert call(server, "1/other", "POST", '{"at": 1}', **kind)[0] == 404
    assert call(server, "1/run", "POST", "[" * 70_000, **kind)[0] == 413
    assert call(server, "1/run", "POST", '{"at": 1}', Origin="http://evil.example", **kind)[0] == 403


def test_a_port_of_another_program(server):
    source = Source([], write, {}, lambda: None)
    with (
        pytest.raises(InputError, match=f"--port {server.server_port}: .*; choose another one"),
        served(source, server.server_port),
    ):
        pass
