"""Whom the server answers: this machine's own pages, at the port that was asked for."""

import http.client
import json
import socket
import time

import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.extensions.play.page import Page
from neuspring.extensions.play.serve import start
from neuspring.report.shown import find
from tests.support.played import results, softer

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Protocol": "viser-v0",
}


def status(server, path="/", **headers: str) -> int:
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
    assert "--port 0 takes any that is free" in capsys.readouterr().err
    for host, port in (("no.such.host.invalid", 0), ("127.0.0.1", 70000)):
        with pytest.raises(InputError, match=r"--host|--port"):
            start(host, port)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("play")
    one = start("127.0.0.1", 0)
    shown = Page(one, find([results(folder)]), folder / "saved")
    yield shown
    shown.close()
    one.stop()


def test_switches_change_the_scene(page):
    body = page.player._bodies["baseline/0"]
    page.parts["nodes"].value = False
    page._changed()
    assert not body.nodes.visible
    before = body.springs.colors.copy()
    page.quantity.value = "strain"
    page._changed()
    assert (body.springs.colors != before).any() and "strain" in page.legend.content
    page.boxes["baseline/0"].value = False
    page._changed()
    assert "baseline/0" not in page.player._bodies
    page.boxes["baseline/0"].value = page.parts["nodes"].value = True
    page._changed()


def test_a_saved_recording_is_compared_and_names_its_twin(page, capsys):
    page.panel.start("baseline/0")
    live = page.panel.live
    live.grab.take(1, "node", 3, live.simulator.positions[3])
    live.grab.pull(1, live.simulator.positions[3] + [0.1, 0, 0])
    end = time.monotonic() + 60
    while live.simulator.frame < 6 and time.monotonic() < end:
        time.sleep(0.05)
    live.grab.release(1)
    page.panel._save()
    page.panel.stop()
    saved = next((page.panel._save_to).glob("controls_small_baseline_0_0.npz"))
    folder = str(page.found.folder)
    assert main(["play", folder, "--replay", str(saved), "--compare"]) == 0
    said = capsys.readouterr().out
    assert "recorded with baseline/0" in said and "neuspring/0" in said
    softer(page.player.run("baseline/0").twin, 0.9).save(page.found.folder / "baseline" / "0" / "twin.npz")
    assert main(["play", folder, "--replay", str(saved), "--compare"]) == 2
    assert "must be among the runs" in capsys.readouterr().err
    assert json.dumps(folder) not in said


LINK = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


def test_a_link_of_a_report_opens_a_frame_of_its_own_scenario_and_nothing_else():
    asked: list[int] = []
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
