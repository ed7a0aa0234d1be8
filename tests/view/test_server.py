"""The server of live pages: what it answers, and to whom."""

import http.client
import json
import socket

import pytest

from quadjax.dashboard.server import Server


@pytest.fixture
def server(tmp_path):
    (tmp_path / "secret.txt").write_text("secret", encoding="utf-8")
    running = Server(lambda: "<p>page</p>", {"/state.json": lambda: {"steps": 1}})
    yield running
    running.close()


def ask(server, path, method="GET", host=None):
    """Status and body of one request, the path sent as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    headers = {"Host": host or f"127.0.0.1:{server.port}"}
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, body, answer.headers


def test_the_page_and_its_documents(server):
    status, body, headers = ask(server, "/")
    assert (status, body) == (200, "<p>page</p>")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["X-Frame-Options"] == "DENY"
    status, body, _ = ask(server, "/state.json?now")
    assert (status, json.loads(body)) == (200, {"steps": 1})


def test_no_file_is_answered(server):
    for path in (
        "/secret.txt",
        "/../secret.txt",
        "/%2e%2e/secret.txt",
        "/..%2fsecret.txt",
        "//etc/passwd",
        "/etc/passwd",
        "/state.json/../secret.txt",
        "/state.json\\..\\secret.txt",
        "file:///etc/passwd",
        "/" + "a" * 5000,
    ):
        status, body, _ = ask(server, path)
        assert status == 404 and "root:" not in body and "secret" not in body, path


def test_other_hosts_and_methods_are_refused(server):
    for host in ("evil.example", "evil.example:80", "127.0.0.1", "192.168.0.2:1"):
        status, body, _ = ask(server, "/state.json", host=host)
        assert status == 421 and "steps" not in body, host
    assert ask(server, "/", host=f"localhost:{server.port}")[0] == 200
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        assert ask(server, "/state.json", method)[0] == 501, method


def test_the_server_listens_on_this_machine_only(server):
    assert server.url.startswith("http://127.0.0.1:")
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None)}
    for address in others - {"127.0.0.1", "::1", "127.0.1.1"}:
        with pytest.raises(OSError):
            socket.create_connection((address, server.port), timeout=2).close()
