"""Fetching the released archives, against a stand-in of the hub on this machine. The real hub is never asked."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import socket
import stat
import subprocess
import sys
import threading
import zipfile
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.extensions.released import fetch as fetching
from neuspring.extensions.released.fetch import LOCK, RECORD, fetch
from neuspring.intake import phystwin
from tests.support.phystwin_case import write_case

COMMIT = "0123456789abcdef0123456789abcdef01234567"
CASE, OTHER = "single_lift_rope", "rope_double_hand"
SIZES = {"frames": 50, "points": 1630, "surface": 400, "interior": 118}
"""Of the released CASE, as check-data demands."""
FINAL_DATA = f"data/different_types/{CASE}/final_data.pkl"


class StandIn(ThreadingHTTPServer):
    """What huggingface_hub asks of a hub: the files of a data set, twice, and ranges of them behind a redirection."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.endpoint = f"http://127.0.0.1:{self.server_port}"
        self.files: dict[str, bytes] = {}
        self.paths: list[str] = []
        self.tokens: list[str | None] = []
        self.served = 0
        """Bytes of files."""
        self.left = 10**12
        """Bytes of files until connections break off."""
        self.ranges = True
        self.extra = b""
        """Appended to every file after its size was declared."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):  # a client that went away is no news
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    server: StandIn
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        path, name = self.path.partition("?")[0], self.path.rpartition("/")[2]
        self.server.paths.append(path)
        self.server.tokens.append(self.headers.get("Authorization"))
        dataset = "datasets/Jianghanxiao/PhysTwin"
        files = [
            {"rfilename": name, "path": name, "type": "file", "size": len(content), "oid": "0" * 40, "blobId": "0" * 40}
            | {"lfs": {"size": len(content), "sha256": hashlib.sha256(content).hexdigest(), "pointerSize": 130}}
            for name, content in self.server.files.items()
        ]
        if path in (f"/api/{dataset}/revision/main", f"/api/{dataset}/revision/{COMMIT}"):
            self._answer(200, json.dumps({"id": "Jianghanxiao/PhysTwin", "sha": COMMIT, "siblings": files}).encode())
        elif path == f"/api/{dataset}/tree/{COMMIT}":
            self._answer(200, json.dumps([{key: file[key] for key in ("path", "type", "size", "oid")} for file in files]).encode())
        elif path.startswith(f"/{dataset}/resolve/{COMMIT}/"):
            self._answer(302, b"", {"Location": f"{self.server.endpoint}/cdn/{name}"})
        elif path.startswith("/cdn/"):
            self._file(self.server.files[name] + self.server.extra)
        else:
            self._answer(404, b"{}", {"X-Error-Code": "RevisionNotFound"})

    def _file(self, content: bytes) -> None:
        wanted = self.headers.get("Range", "")
        if not (wanted and self.server.ranges):
            self._answer(200, content)
            return
        start, end = (int(value) for value in wanted.removeprefix("bytes=").split("-"))
        piece = content[start : end + 1]
        sent = min(len(piece), self.server.left)
        self.server.left -= sent
        self._answer(206, piece, {"Content-Range": f"bytes {start}-{end}/{len(content)}"}, sent)

    def _answer(self, status: int, body: bytes, headers: Mapping[str, str] = MappingProxyType({}), sent: int | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.path.startswith("/cdn/"):
            self.server.served += len(body[:sent])
        self.wfile.write(body[:sent])
        self.close_connection = len(body[:sent]) < len(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="session")
def released(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The archives, of two scenarios: one that check-data accepts, and one with more images."""
    root = tmp_path_factory.mktemp("released")
    rng = np.random.default_rng(0)
    write_case(root, CASE, **SIZES)
    write_case(root, OTHER)
    for case, frames in ((CASE, 10), (OTHER, 40)):
        folder = root / "data" / "different_types" / case
        images = [f"{kind}/0/{t}.{suffix}" for t in range(frames) for kind, suffix in (("color", "png"), ("depth", "npy"))]
        for name in [*images, "mask/mask_info_0.json", "mask/0/1/0.png", "color/0.mp4"]:
            write_bytes(folder / name, rng.bytes(5000))
        write_bytes(root / "data" / "gaussian_data" / case / "0.png", rng.bytes(1000))
        write_bytes(root / "data" / "different_types_human_mask" / case / "mask" / "0" / "0" / "0.png", rng.bytes(1000))
        write_bytes(root / "experiments_optimization" / case / "optimal_params.pkl", rng.bytes(100))
        write_bytes(root / "experiments" / case / "inference.pkl", rng.bytes(1000))
        write_bytes(root / "gaussian_output" / case / "init=hybrid" / "point_cloud.ply", rng.bytes(1000))
    write_bytes(root / "additional_data" / "data" / "shirt" / "final_data.pkl", rng.bytes(1000))
    folders = ("data", "experiments_optimization", "experiments", "gaussian_output", "additional_data")
    return {f"{name}.zip": pack(root, name) for name in folders}


def write_bytes(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def pack(root: Path, folder: str) -> bytes:
    """A zip archive of root/folder."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for path in sorted((root / folder).rglob("*")):
            method = zipfile.ZIP_DEFLATED if path.suffix in (".json", ".pkl") else zipfile.ZIP_STORED
            archive.write(path, path.relative_to(root).as_posix(), compress_type=method)
    return stream.getvalue()


def repack(content: bytes, rename: Callable[[str], str], links: tuple[str, ...] = ()) -> bytes:
    """The archive with other names for its files, some of them links."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(stream, "w") as archive:
        for info in source.infolist():
            entry = zipfile.ZipInfo(rename(info.filename))
            entry.external_attr = (stat.S_IFLNK | 0o777) << 16 if info.filename in links else info.external_attr
            archive.writestr(entry, source.read(info))
    return stream.getvalue()


@pytest.fixture
def server(released: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    from huggingface_hub import constants, hf_file_system
    from huggingface_hub.utils import close_session, http_backoff

    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("HF_TOKEN", raising=False)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_TELEMETRY", True)  # read at import, which another test may have caused
    monkeypatch.setattr(fetching, "BLOCK", 4096)  # as small as the archives
    # The library would ask again for half a minute.
    monkeypatch.setattr(hf_file_system, "http_backoff", partial(http_backoff, max_retries=0))
    close_session()  # its client knows the environment of its first use
    with StandIn() as standin:
        standin.files = dict(released)
        thread = threading.Thread(target=standin.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield standin
        standin.shutdown()
        thread.join()
    close_session()


def files(root: Path) -> dict[str, bytes]:
    """All files below `root` but the hidden and the record."""
    paths = (path for path in root.rglob("*") if path.is_file() and path.name not in (LOCK, RECORD))
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


def test_everything_lands_where_the_reader_looks_and_is_recorded(
    server: StandIn, released: dict[str, bytes], tmp_path: Path
) -> None:
    lines: list[str] = []
    findings = fetch(tmp_path, [CASE, OTHER], ["all", "extra"], endpoint=server.endpoint, say=lines.append)
    expected = {}
    for content in released.values():
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            expected |= {info.filename: archive.read(info) for info in archive.infolist() if not info.is_dir()}
    assert files(tmp_path) == expected
    row = ScenarioRow(scenario=CASE, source="phystwin", category="rope", path=CASE, self_collision=False, ground=True)
    assert phystwin.read(row, tmp_path / "data" / "different_types" / CASE).object_points.shape == (50, 1630, 3)
    refused = {Path(d.where).name for d in findings if d.level == "error" and CASE in d.where}
    assert refused == {"inference.pkl", "optimal_params.pkl"}  # random bytes here: check-data has looked at them
    record = json.loads((tmp_path / RECORD).read_text())["fetched"]
    assert {entry["archive"]: entry["sha256"] for entry in record} == {
        name: hashlib.sha256(content).hexdigest() for name, content in released.items()
    }
    assert {entry["revision"] for entry in record} == {COMMIT}
    assert any(line.startswith("Space needed") for line in lines)


def test_a_fetched_case_passes_check_data_and_is_not_fetched_again(server: StandIn, tmp_path: Path) -> None:
    findings = fetch(tmp_path, [CASE], ["data", "images"], endpoint=server.endpoint)
    assert {d.level for d in findings} == {"note"}
    assert not [d for d in findings if "not one of the 22" in d.message]
    first, record = server.served, (tmp_path / RECORD).read_text()
    fetch(tmp_path, [CASE], ["data", "images"], endpoint=server.endpoint)
    assert server.served - first < 0.2 * first
    assert (tmp_path / RECORD).read_text() == record
    image = tmp_path / "data" / "different_types" / CASE / "color" / "0" / "3.png"
    right = image.read_bytes()
    image.write_bytes(right[:-1] + bytes([right[-1] ^ 1]))
    lines: list[str] = []
    fetch(tmp_path, [CASE], ["images"], endpoint=server.endpoint, say=lines.append)
    assert image.read_bytes() == right
    assert any("1 with other content on disk are replaced" in line for line in lines)


def test_one_scenario_costs_neither_the_other_nor_the_other_archives(server: StandIn, tmp_path: Path) -> None:
    fetch(tmp_path, [CASE], ["images"], endpoint=server.endpoint)
    fetched = files(tmp_path)
    assert f"data/different_types/{CASE}/color/0/9.png" in fetched
    assert not [name for name in fetched if OTHER in name or name.endswith(("final_data.pkl", ".mp4"))]
    assert not [path for path in server.paths if "experiments" in path]
    toc = 140 * sum(1 for _ in zipfile.ZipFile(io.BytesIO(server.files["data.zip"])).infolist())
    wanted = sum(len(content) for content in fetched.values())
    assert server.served < wanted * 1.05 + toc + 3 * fetching.BLOCK


def test_parts_keep_to_themselves(server: StandIn, tmp_path: Path) -> None:
    fetch(tmp_path, [CASE], ["results"], endpoint=server.endpoint)
    assert set(files(tmp_path)) == {f"experiments/{CASE}/inference.pkl", f"experiments_optimization/{CASE}/optimal_params.pkl"}
    fetch(tmp_path, [CASE], ["appearance"], endpoint=server.endpoint)
    added = {f"gaussian_output/{CASE}/init=hybrid/point_cloud.ply", f"data/gaussian_data/{CASE}/0.png"}
    assert added < set(files(tmp_path))
    assert FINAL_DATA not in files(tmp_path)


def test_an_interrupted_fetch_continues_where_it_was(server: StandIn, tmp_path: Path) -> None:
    fetch(tmp_path / "whole", [OTHER], ["images"], endpoint=server.endpoint)
    whole, server.served = server.served, 0
    server.left = 200_000
    with pytest.raises(InputError, match="the same command continues"):
        fetch(tmp_path / "broken", [OTHER], ["images"], endpoint=server.endpoint)
    finished = files(tmp_path / "broken")
    assert 10 < len(finished) < 80
    assert not [name for name in finished if name.endswith(".part")]
    server.left, server.served = 10**12, 0
    fetch(tmp_path / "broken", [OTHER], ["images"], endpoint=server.endpoint)
    assert files(tmp_path / "broken") == files(tmp_path / "whole")
    assert server.served <= whole - sum(len(content) for content in finished.values())


def test_a_damaged_member_is_named_and_leaves_no_file(server: StandIn, tmp_path: Path) -> None:
    content = server.files["data.zip"]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        start = archive.getinfo(f"data/different_types/{CASE}/color/0/5.png").header_offset
    server.files["data.zip"] = content[: start + 2000] + bytes([content[start + 2000] ^ 1]) + content[start + 2001 :]
    with pytest.raises(InputError, match=r"data\.zip: .*color/0/5\.png.*Bad CRC-32"):
        fetch(tmp_path, [CASE], ["images"], endpoint=server.endpoint)
    names = set(files(tmp_path))
    assert f"data/different_types/{CASE}/color/0/4.png" in names
    assert not [name for name in names if "5.png" in name]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda server: server.files.update({"data.zip": b"no archive" * 500}), "must be a zip archive"),
        (lambda server: server.files.pop("data.zip"), "data.zip is required"),
        (lambda server: setattr(server, "extra", b"more"), "of the declared size .*received 206 bytes 0-0/"),
        (lambda server: setattr(server, "ranges", False), "must serve parts of a file .*received 200"),
    ],
    ids=["no zip", "no file", "another size", "no ranges"],
)
def test_what_is_not_the_declared_archive_is_refused(
    server: StandIn, tmp_path: Path, change: Callable[[StandIn], object], message: str
) -> None:
    change(server)
    with pytest.raises(InputError, match=message):
        fetch(tmp_path, [CASE], ["data"], endpoint=server.endpoint)
    assert not files(tmp_path)
    assert len([path for path in server.paths if path.startswith("/cdn/")]) <= 3, "no archive is read from a server without ranges"


def test_a_dry_run_writes_nothing_and_too_little_space_is_refused(
    server: StandIn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    assert fetch(tmp_path / "new", [CASE], ["images"], dry_run=True, endpoint=server.endpoint, say=lines.append) == []
    assert any(line.startswith("data.zip: 24 files asked for, 0 are there") for line in lines)
    assert not (tmp_path / "new").exists()
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 0, 100_000))
    with pytest.raises(InputError, match=r"must be free; received 0\.1 MB"):
        fetch(tmp_path, [CASE], ["images"], endpoint=server.endpoint, say=lines.append)
    assert lines[-1].endswith("free: 0.1 MB")
    assert not files(tmp_path)


def test_unknown_scenarios_and_parts_are_refused_with_what_was_meant(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"single_lift_ropes.*Close to it: single_lift_rope"):
        fetch(tmp_path, ["single_lift_ropes"])
    with pytest.raises(InputError, match=r"--parts: must be among data, .*received pictures"):
        fetch(tmp_path, [CASE], ["pictures"])


INSIDE = f"data/different_types/{CASE}/../../../../final_data.pkl"


@pytest.mark.parametrize(
    "name",
    [f"/{FINAL_DATA}", f"C:/{FINAL_DATA}", f"../{FINAL_DATA}", INSIDE, FINAL_DATA.replace("/", "\\"), None],
    ids=["absolute", "drive", "above", "inside", "backslash", "link"],
)
def test_an_archive_with_an_unsafe_member_is_refused_as_a_whole(server: StandIn, tmp_path: Path, name: str | None) -> None:
    links = () if name else (FINAL_DATA,)
    server.files["data.zip"] = repack(server.files["data.zip"], lambda old: name if name and old == FINAL_DATA else old, links)
    with pytest.raises(InputError, match="plain files at relative paths only"):
        fetch(tmp_path / "root", [CASE], ["all"], endpoint=server.endpoint)
    assert files(tmp_path) == {}


def test_an_encrypted_member_is_refused(server: StandIn, tmp_path: Path) -> None:
    content = bytearray(server.files["data.zip"])
    # The flags lie 38 bytes before the name, in the table of contents at the end.
    content[content.rindex(FINAL_DATA.encode()) - 38] |= 1
    server.files["data.zip"] = bytes(content)
    with pytest.raises(InputError, match="plain files at relative paths only, no links, and none encrypted"):
        fetch(tmp_path, [CASE], endpoint=server.endpoint)
    assert files(tmp_path) == {}


@pytest.mark.parametrize("prefix", ["", "release/v1/data/"], ids=["bare", "deeper"])
def test_other_folders_around_the_cases_are_found_out(server: StandIn, tmp_path: Path, prefix: str) -> None:
    stream = io.BytesIO(repack(server.files["data.zip"], lambda name: prefix + name.removeprefix("data/")))
    with zipfile.ZipFile(stream, "a") as archive:
        archive.writestr(f"__MACOSX/data/different_types/{CASE}/._final_data.pkl", b"junk")
        archive.writestr(f"old/different_types/{CASE}/final_data.pkl", b"a stray copy")
        archive.writestr(f"notes/{CASE}/final_data.pkl", b"something else")
    server.files["data.zip"] = stream.getvalue()
    server.files["experiments.zip"] = repack(server.files["experiments.zip"], lambda name: f"runs/{name.partition('/')[2]}")
    fetch(tmp_path, [CASE], ["data", "images", "results"], endpoint=server.endpoint)
    fetched = files(tmp_path)
    assert len(fetched[FINAL_DATA]) > 10_000
    assert f"experiments/{CASE}/inference.pkl" in fetched
    assert {name.split("/")[0] for name in fetched} == {"data", "experiments", "experiments_optimization"}


def test_what_an_archive_lacks_is_said(server: StandIn, tmp_path: Path) -> None:
    findings = fetch(tmp_path, [CASE, "single_push_rope"], ["data"], endpoint=server.endpoint)
    assert [Path(d.where).name for d in findings if "processed data are required" in d.message] == ["single_push_rope"]
    with pytest.raises(InputError, match="First paths in the archive: data/different_types/"):
        fetch(tmp_path, ["single_push_rope"], ["data"], endpoint=server.endpoint)


def test_a_failure_names_the_hub_and_the_next_move(server: StandIn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        away = f"http://127.0.0.1:{taken.getsockname()[1]}"
    with pytest.raises(InputError, match=rf"{away}: the hub must answer; received ConnectError.*HF_ENDPOINT"):
        fetch(tmp_path, [CASE], endpoint=away)
    with pytest.raises(InputError, match=r"received RevisionNotFoundError.*Check .* --revision"):
        fetch(tmp_path, [CASE], revision="v9", endpoint=server.endpoint)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(InputError, match=r"received OfflineModeIsEnabled.*that HF_HUB_OFFLINE is not set"):
        fetch(tmp_path, [CASE], endpoint=server.endpoint)


def test_a_folder_in_use_or_that_cannot_be_written_is_named(server: StandIn, tmp_path: Path) -> None:
    with FileLock(tmp_path / LOCK), pytest.raises(InputError, match="one fetch at a time"):
        fetch(tmp_path, [CASE], endpoint=server.endpoint)
    (tmp_path / "data").write_text("a file")
    with pytest.raises(InputError, match="must be readable and writable"):
        fetch(tmp_path, [CASE], ["data"], endpoint=server.endpoint)


@pytest.mark.parametrize("token", ["", "hf_given"])
def test_no_telemetry_is_sent_and_a_token_only_where_the_environment_has_one(server: StandIn, tmp_path: Path, token: str) -> None:
    (tmp_path / "token").write_text("hf_stored")
    environment = os.environ | {"HF_ENDPOINT": server.endpoint, "HF_HOME": str(tmp_path), "HF_TOKEN": token, "HF_HUB_OFFLINE": ""}
    environment.pop("HF_HUB_DISABLE_TELEMETRY", None)
    code = "import sys; from neuspring.extensions.released.fetch import fetch; fetch(sys.argv[1], [sys.argv[2]], dry_run=True)"
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "root"), CASE], env=environment, check=True, capture_output=True)
    allowed = ("/api/datasets/Jianghanxiao/PhysTwin/", "/datasets/Jianghanxiao/PhysTwin/resolve/", "/cdn/")
    assert server.paths
    assert all(path.startswith(allowed) for path in server.paths)
    assert set(server.tokens) == ({f"Bearer {token}"} if token else {None})
