"""Read-only access to one data set repository of the Hugging Face hub. Its files are read by HTTP range requests."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

# The library reads this when it is first imported.
os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")

from huggingface_hub import HfApi, HfFileSystem, errors, hf_hub_url
from huggingface_hub.hf_file_system import HfFileSystemFile
from huggingface_hub.utils import build_hf_headers, hf_raise_for_status, http_stream_backoff, httpx

from neuspring import __version__
from neuspring.core.errors import InputError

TIMEOUT = 30.0
"""Seconds without a byte after which a request has failed."""
BLOCK = 2**24
"""Bytes that are read ahead in one range request."""
GAP = 2**20
"""Spans that lie closer, bytes, are read as one: a further request takes as long."""


@dataclass(frozen=True)
class HubFile:
    """What the hub declares about a file."""

    name: str
    size: int
    """Bytes."""
    sha256: str
    """SHA-256 of the whole file; empty where the hub gives none."""


class RemoteFile(HfFileSystemFile):
    """A binary file of the hub, for `zipfile`. The library reads ahead, and retries lost connections."""

    _spans: Sequence[tuple[int, int]] = ()

    def expect(self, spans: Iterable[tuple[int, int]]) -> int:
        """Announce the spans [start, end) that will be read, ascending: reading ahead stops at their ends. Returns their bytes."""
        joined: list[tuple[int, int]] = []
        for start, end in spans:
            first = joined.pop()[0] if joined and start - joined[-1][1] <= GAP else start
            joined.append((first, end))
        self._spans = joined
        return sum(end - start for start, end in joined)

    def _fetch_range(self, start: int, end: int) -> bytes:
        end = next((last for first, last in self._spans if first <= start < last < end), end)
        url = self.url()
        with _explained(url, self.path):
            content = bytes(super()._fetch_range(start, end))
        if len(content) != end - start:
            raise _broken_off(url, f"{len(content)} of {end - start} bytes")
        return content


class Hub:
    """One data set repository at one commit. Sends no telemetry, and a token only if HF_TOKEN holds one.

    Every failure of the hub or of the network raises InputError with the next move, here and in every later call.
    """

    def __init__(self, repository: str, revision: str, endpoint: str | None = None) -> None:
        token = os.environ.get("HF_TOKEN") or False
        api = HfApi(endpoint=endpoint, token=token, library_name="neuspring", library_version=__version__)
        self.repository, self.endpoint = repository, api.endpoint
        self._headers = build_hf_headers(token=token, library_name="neuspring", library_version=__version__)
        self._system = HfFileSystem(endpoint=endpoint, token=token, skip_instance_cache=True)
        with _explained(f"{self.endpoint}: {repository}", revision):
            info = api.dataset_info(repository, revision=revision, files_metadata=True, timeout=TIMEOUT)
        self.commit = str(info.sha)
        self.files = {
            file.rfilename: HubFile(file.rfilename, int(file.size or 0), file.lfs.sha256 if file.lfs else "")
            for file in info.siblings or []
        }

    def open(self, file: HubFile) -> RemoteFile:
        """Open a file for reading. Checks that the server has it in the declared size and serves parts of it."""
        self._require_ranges(file)
        path = f"datasets/{self.repository}@{self.commit}/{file.name}"
        with _explained(path, self.commit):
            return RemoteFile(self._system, path, size=file.size, block_size=BLOCK, cache_type="readahead")

    def _require_ranges(self, file: HubFile) -> None:
        """The library would read a whole archive from a server that ignores ranges; here only the head of an answer is read."""
        url = hf_hub_url(self.repository, file.name, repo_type="dataset", revision=self.commit, endpoint=self.endpoint)
        headers = self._headers | {"Range": "bytes=0-0", "Accept-Encoding": "identity"}
        with _explained(url, self.commit), http_stream_backoff("GET", url, headers=headers, timeout=TIMEOUT) as response:
            hf_raise_for_status(response)
            status, extent = response.status_code, response.headers.get("Content-Range", "")
        if status != 206:
            remedy = "Choose another server with HF_ENDPOINT."
            raise InputError(url, "the server must serve parts of a file (HTTP status 206)", status, remedy)
        if extent.rpartition("/")[2] != str(file.size):
            remedy = "Run the same command again, or choose another server with HF_ENDPOINT."
            raise InputError(url, f"the hub declares {file.size} bytes", extent or "no size", remedy)


@contextmanager
def _explained(where: str, revision: str) -> Iterator[None]:
    """Raise failures of the hub and of the network as InputError."""
    try:
        yield
    except InputError:
        raise
    except errors.OfflineModeIsEnabled as error:
        remedy = "Unset it (or TRANSFORMERS_OFFLINE)."
        raise InputError("HF_HUB_OFFLINE", "fetching needs the hub", "offline mode", remedy) from error
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
