"""Read-only access to one data set repository of the Hugging Face hub, and to its files by HTTP range requests."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

from neuspring import __version__
from neuspring.core.errors import InputError

RETRIES = 5
"""Of one request, with growing pauses: half a minute in all."""
TIMEOUT = 30.0
"""Seconds without a byte until a request has failed."""
BLOCK = 2**20
"""Bytes of one request where no span was announced (the table of contents of an archive)."""
GAP = 2**20
"""Spans that lie closer, bytes, are fetched as one: a request takes as long."""
CHUNK = 2**24
"""Bytes of one request within a span."""
AHEAD = 4
"""Requests in flight."""


@dataclass(frozen=True)
class HubFile:
    """What the hub declares about a file."""

    name: str
    size: int
    """Bytes."""
    sha256: str
    """Of the whole file; empty where the hub gives none."""


class Hub:
    """One data set repository at one commit. Sends no telemetry, and a token only if HF_TOKEN holds one.

    Raises InputError with the next move for everything that fails between here and there, here and in every later call.
    """

    def __init__(self, repository: str, revision: str, endpoint: str | None = None) -> None:
        os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")  # read once, when huggingface_hub is first imported
        from huggingface_hub import HfApi
        from huggingface_hub.utils import build_hf_headers

        token = os.environ.get("HF_TOKEN") or False
        api = HfApi(endpoint=endpoint, token=token, library_name="neuspring", library_version=__version__)
        self.repository, self.endpoint = repository, api.endpoint
        self._headers = build_hf_headers(token=token, library_name="neuspring", library_version=__version__)
        self._headers["Accept-Encoding"] = "identity"  # ranges of the file as it is
        with _explained(f"{self.endpoint}: {repository}", revision):
            info = api.dataset_info(repository, revision=revision, files_metadata=True, timeout=TIMEOUT)
        self.commit = str(info.sha)
        self.files = {
            file.rfilename: HubFile(file.rfilename, int(file.size or 0), file.lfs.sha256 if file.lfs else "")
            for file in info.siblings or []
        }

    def open(self, file: HubFile) -> RemoteFile:
        """A file to read from. Checks that the server has it in the declared size and serves parts of it."""
        from huggingface_hub import hf_hub_url
        from huggingface_hub.utils import hf_raise_for_status, http_backoff, http_stream_backoff

        url = hf_hub_url(self.repository, file.name, repo_type="dataset", revision=self.commit, endpoint=self.endpoint)

        def get(start: int, end: int) -> bytes:
            headers = self._headers | {"Range": f"bytes={start}-{end - 1}"}
            with _explained(url, self.commit):
                response = http_backoff("GET", url, headers=headers, timeout=TIMEOUT, max_retries=RETRIES)
                hf_raise_for_status(response)
            if len(response.content) != end - start:
                raise _broken_off(url, f"{len(response.content)} of {end - start} bytes")
            return bytes(response.content)

        # Only the head of this answer is read: a server that ignores ranges would send the whole archive.
        headers = self._headers | {"Range": "bytes=0-0"}
        with (
            _explained(url, self.commit),
            http_stream_backoff("GET", url, headers=headers, timeout=TIMEOUT, max_retries=RETRIES) as response,
        ):
            hf_raise_for_status(response)
            status, extent = response.status_code, response.headers.get("Content-Range", "")
        if status != 206:
            remedy = "Choose another server with HF_ENDPOINT."
            raise InputError(url, "the server must serve parts of a file (HTTP status 206)", status, remedy)
        if extent.rpartition("/")[2] != str(file.size):
            remedy = "Run the same command again, or choose another server with HF_ENDPOINT."
            raise InputError(url, f"the hub declares {file.size} bytes", extent or "no size", remedy)
        return RemoteFile(get, file.size)


class RemoteFile:
    """A binary file behind `get(start, end)`, for zipfile. What is announced by `expect` is fetched ahead, in order."""

    def __init__(self, get: Callable[[int, int], bytes], size: int) -> None:
        self._get, self._size = get, size
        self._position = 0
        self._window = (0, b"")
        self._chunks: list[tuple[int, int]] = []
        self._ahead: dict[int, Future[bytes]] = {}
        self._pool = ThreadPoolExecutor(AHEAD)

    def expect(self, spans: Iterable[tuple[int, int]]) -> int:
        """Announce the spans [start, end) that will be read, in ascending order. Returns the bytes that they will cost."""
        self._chunks = list(_chunks(spans))
        return sum(end - start for start, end in self._chunks)

    def close(self) -> None:
        """Drop what is in flight."""
        self._pool.shutdown(cancel_futures=True)

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        self._position = max(0, offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence])
        return self._position

    def read(self, size: int = -1, /) -> bytes:
        end = self._size if size < 0 else min(self._position + size, self._size)
        pieces = []
        while self._position < end:
            start, data = self._window_at(self._position)
            pieces.append(data[self._position - start : end - start])
            self._position += len(pieces[-1])
        return b"".join(pieces)

    def _window_at(self, position: int) -> tuple[int, bytes]:
        start, data = self._window
        if not start <= position < start + len(data):
            index = bisect_right(self._chunks, position, key=lambda chunk: chunk[0]) - 1
            if index >= 0 and position < self._chunks[index][1]:
                self._window = (self._chunks[index][0], self._chunk(index))
            else:
                start = position // BLOCK * BLOCK
                self._window = (start, self._get(start, min(start + BLOCK, self._size)))
        return self._window

    def _chunk(self, index: int) -> bytes:
        for i in range(index, min(index + AHEAD, len(self._chunks))):
            if i not in self._ahead:
                self._ahead[i] = self._pool.submit(self._get, *self._chunks[i])
        return self._ahead.pop(index).result()


def _chunks(spans: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Ascending spans, joined over small gaps and cut into requests."""
    joined: list[tuple[int, int]] = []
    for start, end in spans:
        if joined and start - joined[-1][1] <= GAP:
            start = joined.pop()[0]
        joined.append((start, end))
    for start, end in joined:
        for cut in range(start, end, CHUNK):
            yield cut, min(cut + CHUNK, end)


@contextmanager
def _explained(where: str, revision: str) -> Iterator[None]:
    """Failures of the hub and of the way there, as InputError."""
    from huggingface_hub import errors
    from huggingface_hub.utils import httpx

    try:
        yield
    except InputError:
        raise
    except errors.OfflineModeIsEnabled as error:
        raise InputError(
            "HF_HUB_OFFLINE", "fetching needs the hub", "offline mode", "Unset it (or TRANSFORMERS_OFFLINE)."
        ) from error
    except errors.RevisionNotFoundError as error:
        rule = f"must be a branch, tag or commit of {where}"
        raise InputError("--revision", rule, revision, "Leave it out for the newest state.") from error
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        if status in (401, 403, 404):
            remedy = "Check HF_ENDPOINT; if the hub asks for a login, set HF_TOKEN to a token that may read."
            raise InputError(where, "must be readable at the hub", f"HTTP status {status}", remedy) from error
        raise _broken_off(where, f"HTTP status {status}") from error
    # RuntimeError: a failed connection of one thread closes the client that all threads share. ValueError: not JSON.
    except (httpx.HTTPError, httpx.InvalidURL, OSError, RuntimeError, ValueError, KeyError) as error:
        raise _broken_off(where, f"{type(error).__name__}: {error}".partition("\n")[0]) from error


def _broken_off(where: str, received: str) -> InputError:
    remedy = "Once the network is back, the same command continues; HF_ENDPOINT=<address> names another server (a mirror)."
    return InputError(where, "the hub must answer", received, remedy)
