"""The server of a page: one path, this machine, nothing else."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator

import pytest

from meshsplats.viewer.server import PageServer, serving

PAGE = "<!doctype html><title>größer</title>"


@pytest.fixture
def server() -> Iterator[PageServer]:
    with serving(PAGE) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def ask(
    server: PageServer, path: str, method: str = "GET", **headers: str
) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def test_the_page_is_at_its_address(server):
    assert server.url == f"http://127.0.0.1:{server.server_port}{server.path}"
    status, headers, body = ask(server, server.path)
    assert status == 200
    assert body.decode() == PAGE
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Cache-Control"] == "no-store"
    status, headers, body = ask(server, server.path, "HEAD")
    assert (status, headers["Content-Length"], body) == (200, str(len(PAGE.encode())), b"")


def test_other_paths_hold_nothing(server):
    for path in (
        "/",
        "/favicon.ico",
        server.path[:-2] + "/",
        server.path + "x",
        server.path + "?a",
        "/../etc/passwd",
    ):
        assert ask(server, path)[0] == 404
    assert ask(server, server.path, "POST")[0] == 501


def test_other_names_of_this_machine_are_refused(server):
    """A page elsewhere can make its own name lead to 127.0.0.1, but asks with that name."""
    port = server.server_port
    for host in ("evil.example", f"evil.example:{port}", f"localhost.evil.example:{port}", "localhost:a", ""):
        status, _, body = ask(server, server.path, Host=host)
        assert status == 404
        assert f"open it as http://localhost:{port}{server.path}, from elsewhere" in body.decode()
        assert server.path not in ask(server, "/", Host=host)[2].decode()


def test_a_tunnel_may_have_any_port(server):
    for host in (
        f"localhost:{server.server_port}",
        "localhost:9999",
        "127.0.0.1",
        "Localhost:80",
        "[::1]:9999",
    ):
        assert ask(server, server.path, Host=host)[0] == 200


def test_addresses_differ_and_cannot_be_guessed():
    with serving(PAGE) as one, serving(PAGE) as other:
        assert one.server_port != other.server_port
        assert one.path != other.path
        assert len(one.path) > 30
        assert one.server_address[0] == "127.0.0.1"
