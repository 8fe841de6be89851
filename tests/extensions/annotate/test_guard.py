"""Hostile requests are refused without any data."""

import json
import socket

import cv2
import numpy as np
import pytest

from neuspring.core import web as guard
from neuspring.core.errors import InputError
from neuspring.extensions.annotate.server import MOST_REQUEST_BYTES, STATIC_FOLDER, Server
from tests.extensions.annotate.served import TOKEN, served
from tests.support.moving import moving

BODY = json.dumps({"revision": "none", "marks": {"format": 1, "cameras": {}}}).encode()


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "secret.txt").write_text("secret")
    with served(moving(folder / "capture")) as client:
        yield client


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "10.0.0.1", "[::2]", "", "["])
def test_other_names_of_this_address_are_refused(client, host):
    """DNS rebinding: a name of another site that leads here."""
    for path in ("/", "/app.js", "/api/state"):
        status, _, content = client.raw("GET", path, Host=host)
        assert status in (400, 403)
        assert b"frames" not in content and b"<html" not in content


@pytest.mark.parametrize("host", ["localhost:1", "127.0.0.1", "LOCALHOST", "[::1]:80"])
def test_names_of_this_machine_are_taken_at_any_port(client, host):
    """An SSH tunnel may end at another port."""
    assert client.raw("GET", "/api/state", Host=host)[0] == 200


def host(header, bound):
    try:
        guard.check_host(header, bound)
    except guard.Refused:
        return False
    return True


def test_a_server_for_a_network_is_reached_by_address_or_by_its_own_name():
    assert host("192.168.1.7:8765", "0.0.0.0")
    assert host(f"{socket.gethostname()}:8765", "0.0.0.0")
    assert not host("evil.example:8765", "0.0.0.0")
    assert not host("192.168.1.7:8765", "127.0.0.1")
    assert not host("192.168.1.7:8765", "::1")
    assert not host(None, "0.0.0.0")


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"X_NeuSpring_Token": None}, 401),
        ({"X_NeuSpring_Token": "guess"}, 401),
        ({"X_NeuSpring_Token": "tokén"}, 401),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
        ({"Content_Type": "text/plain"}, 415),
        ({"Content_Type": "application/x-www-form-urlencoded"}, 415),
        ({"Content_Length": None}, 411),
        ({"Content_Length": "-5"}, 400),
        ({"Transfer_Encoding": "chunked"}, 411),
        ({"Content_Length": str(MOST_REQUEST_BYTES + 1)}, 413),
        ({"Content_Length": "9" * 50}, 400),
    ],
)
def test_hostile_writes_are_refused_and_change_nothing(client, headers, status):
    assert client.raw("POST", "/api/marks", BODY, **headers)[0] == status
    assert not (client.server.capture.folder / "marks.json").exists()


def test_requests_of_the_page_itself_are_taken(client):
    origin = f"http://127.0.0.1:{client.port}"
    status, headers, _ = client.raw("GET", "/api/state", Origin=origin, Sec_Fetch_Site="same-origin")
    assert status == 200
    assert headers["content-security-policy"].startswith("default-src 'self'")
    assert not any(name.startswith("access-control") for name in headers)


@pytest.mark.parametrize(
    "path",
    [
        "/../capture/capture.json", "/%2e%2e/secret.txt", "/../server.py", "/..%2fserver.py", "/capture.json", "/static/app.js",
        "//etc/passwd", "/%2fetc/passwd", "/app.py", "/api/color/0/..%2f..%2f..%2fsecret.txt", "/api/color/..%2f..%2f../0",
        "/api/color/%2e%2e/0", "/api/color/0/99999999999", "/api/color/0/12", "/api/color/0/-1", "/api/color/2/0",
        "/api/overlay/..%2f/0/0", "/api/overlay/other/0/0", "/api/overlay/saved/0/0", "/api/nothing",
    ],
)  # fmt: skip
def test_no_address_leads_out_of_the_capture(client, path):
    status, _, content = client.raw("GET", path)
    assert status == 404
    assert set(json.loads(content)) == {"error"}


def test_a_link_in_the_capture_gives_no_file_that_is_not_its_image(tmp_path):
    capture = moving(tmp_path / "capture")
    (tmp_path / "secret.txt").write_text("secret")
    path = capture.path("color", "0", 1)
    path.unlink()
    path.symlink_to(tmp_path / "secret.txt")
    with served(capture) as client:
        status, _, content = client.raw("GET", "/api/color/0/1")
        assert status == 422
        assert b"secret" not in content.replace(b"secret.txt", b"")
        # An image of another size is none of this camera.
        path.unlink()
        cv2.imwrite(str(path), np.zeros((8, 8, 3), np.uint8))
        assert client.raw("GET", "/api/color/0/1")[0] == 422


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b"1", b"[" * 100_000, b"\xff\xfe"])
def test_bodies_that_are_no_object_are_refused(client, body):
    assert client.raw("POST", "/api/marks", body)[0] == 400


def test_all_under_api_needs_the_token_and_other_methods_are_not_there(client):
    for path in ("/api/state", "/api/color/0/0", "/api/masks", "/api/nothing"):
        assert client.raw("GET", path, X_NeuSpring_Token=None)[0] == 401
    for method in ("PUT", "DELETE", "OPTIONS", "PATCH"):
        assert client.raw(method, "/api/marks")[0] == 405


def test_the_page_comes_from_the_package_alone(client):
    """Every file of the page is given out, and none of them asks the network for more."""
    for name in ("", *(path.name for path in STATIC_FOLDER.iterdir())):
        status, headers, content = client.raw("GET", f"/{name}", X_NeuSpring_Token=None)
        assert status == 200
        assert headers["x-content-type-options"] == "nosniff"
        assert TOKEN.encode() not in content
        assert b"://" not in content.replace(b"http://www.w3.org/2000/svg", b"")


def test_addresses_that_cannot_be_had_say_the_next_move(client):
    for where, message in (
        ({"port": 70000}, "--port: must be 0 to 65535"),
        ({"port": client.port}, "--port: must be a free port"),
        ({"host": "192.0.2.1"}, "--host: must be an address of this machine"),
        ({"host": "no.such.name.invalid"}, "--host: must be an address of this machine"),
    ):
        with pytest.raises(InputError, match=message):
            Server(client.server.capture, **where)


def test_the_address_has_the_token_where_no_server_logs_it(client):
    server = Server(client.server.capture)
    try:
        assert server.url == f"http://127.0.0.1:{server.port}/#{server.token}"
        assert len(server.token) >= 20
    finally:
        server.close()
