"""The server answers only pages of this machine, at the requested port."""

import http.client
import socket

import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.extensions.play.serve import start
from tests.support.played import results

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Protocol": "viser-v0",
}


def status(server, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=20)
    try:
        connection.putrequest("GET", path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


def test_the_page_is_served_and_kept_by_no_browser_whose_connection_would_go_on(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=20)
    connection.request("GET", "/")
    answer = connection.getresponse()
    connection.close()
    found = (answer.status, answer.getheader("Cache-Control"), answer.getheader("X-Frame-Options"))
    assert found == (200, "no-store", "DENY")
    assert server.request_share_url() is None, "nobody can publish the server"


def test_no_path_leads_to_a_file_of_this_machine(server):
    for path in ("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/..%5c..%5cetc/passwd", "//etc/passwd", "/observations.npz"):
        assert status(server, path) == 404, path


@pytest.mark.parametrize("headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Sec-Fetch-Site": "cross-site"}])
@pytest.mark.parametrize("upgrade", [{}, UPGRADE], ids=["page", "socket"])
def test_pages_of_other_sites_are_refused(server, headers, upgrade):
    assert status(server, **(upgrade | headers)) == 403


def test_a_port_in_use_and_a_place_that_is_none_are_refused(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["play", str(results(tmp_path)), "--port", str(port)]) == 2
    assert "--port 0 selects a free one" in capsys.readouterr().err
    for host, port in (("no.such.host.invalid", 0), ("127.0.0.1", 70000)):
        with pytest.raises(InputError, match=r"--host|--port"):
            start(host, port)


LINK = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


def test_a_link_of_a_report_opens_a_frame_of_its_own_scenario_and_nothing_else():
    asked = []
    one = start("127.0.0.1", 0, asked.append, "rope")
    try:
        for path, answer in {
            "/?frame=5": 200,
            "/?frame=6&scenario=rope": 200,
            "/?frame=7&scenario=cloth": 404,
            "/": 200,
            "/?frame=-1": 403,
            "/?websocket=ws://evil.example": 403,
            "/?frame=1&websocket=ws://evil.example": 403,
            "/assets/x.js": 403,
        }.items():
            assert status(one, path, **LINK) == answer, path
        for changes in ({"Sec-Fetch-Dest": "iframe"}, {"Sec-Fetch-Mode": "no-cors"}):
            assert status(one, "/?frame=8", **(LINK | changes)) == 403
            assert status(one, "/", **(LINK | UPGRADE)) == 403
        assert asked == [5, 6]
    finally:
        one.stop()
