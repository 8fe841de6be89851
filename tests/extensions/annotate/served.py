"""The server of `neuspring annotate` in a thread, and requests to it."""

import http.client
import json
import time
from contextlib import contextmanager
from threading import Thread

import cv2
import numpy as np

from neuspring.extensions.annotate.server import TOKEN_HEADER, Server

TOKEN = "the-token"


class Client:
    """Requests to a server."""

    def __init__(self, server):
        self.server, self.port = server, server.port

    def raw(self, method, path, body=None, **headers):
        """Status, headers and body; the token is sent, and underscores in names of headers are dashes; None leaves one out."""
        sent = {TOKEN_HEADER: TOKEN} | {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        connection.putrequest(method, path, skip_host="Host" in sent, skip_accept_encoding=True)
        if body is not None:
            sent = {"Content-Type": "application/json", "Content-Length": str(len(body))} | sent
        for name, value in sent.items():
            if value is not None:
                connection.putheader(name, value)
        # A body of another length than the headers say stays unread: the server closes on it, and a reset may overtake its answer.
        whole = body is not None and sent["Content-Length"] == str(len(body)) and "Transfer-Encoding" not in sent
        connection.endheaders(body if whole else None)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, dict(answer.getheaders()), content

    def get(self, path):
        """JSON of an answer that must be good."""
        status, _, content = self.raw("GET", path)
        assert status == 200, content
        return json.loads(content)

    def image(self, path):
        """An image of an answer that must be good, as OpenCV has it."""
        status, _, content = self.raw("GET", path)
        assert status == 200, content
        return decoded(content)

    def post(self, path, **values):
        """Status and JSON of an answer."""
        status, _, content = self.raw("POST", path, json.dumps(values).encode())
        return status, json.loads(content)

    def wait(self, condition, seconds=30.0):
        """Value of a condition once it is true."""
        end = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < end, "it did not happen"
            time.sleep(0.02)
        return value


def decoded(content):
    """The image of some bytes."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def show(browser, client, width=1280, height=800):
    """Open the page of a server, and wait until it can be used."""
    browser.open("about:blank", width, height)
    browser.open(f"http://127.0.0.1:{client.port}/#{TOKEN}", width, height)
    browser.wait("document.body.dataset.ready === 'yes'")


@contextmanager
def served(capture):
    """A server for a capture, while the block runs."""
    server = Server(capture, token=TOKEN)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield Client(server)
    finally:
        server.shutdown()
        thread.join()
        server.close()
