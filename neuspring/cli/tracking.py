"""Commands on MLflow: track-init, log, sync, compare, ui."""

from __future__ import annotations

import json
import os
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.cli import options as shared
from neuspring.core.files import write_text
from neuspring.core.provenance import commit_named


def track_init_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring track-init`."""
    add_results(parser)
    shared.add_settings(parser)
    shared.add_output(parser)


def track_init(a: Namespace) -> None:
    """`neuspring track-init`."""
    from neuspring.experiments.tracking import log

    outcome = log.init(a.results, shared.read_settings(a.settings).tracking)
    write_text(a.output, json.dumps(outcome, indent=1, sort_keys=True) + "\n")
    print(f"MLflow: {outcome['outcome']}")


def log_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring log`."""
    shared.add_record(parser, "record", "run.json")
    track_init_options(parser)


def log(a: Namespace) -> None:
    """`neuspring log`."""
    from neuspring.experiments.tracking import log

    outcome = log.log_run(a.record, a.results, shared.read_settings(a.settings).tracking)
    write_text(a.output, outcome + "\n")
    print(f"MLflow: {a.record}: {outcome}")


def sync_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring sync`."""
    add_results(parser)
    shared.add_settings(parser)
    parser.add_argument("--under", type=Path, help="only the records under this folder of the results")
    parser.add_argument("--output", type=Path, help="file for the counts; failures are then not an error")


def sync(a: Namespace) -> int:
    """`neuspring sync`: 1 where something could not be sent."""
    from neuspring.experiments.tracking import log

    settings = shared.read_settings(a.settings).tracking
    log.init(a.results, settings)
    outcomes = log.sync(a.results, settings, progress=print, under=a.under)
    counts = "\n".join(f"{outcome}: {len(names)}" for outcome, names in outcomes.items())
    print(counts)
    if a.output:
        # A step of the workflow: what could not be sent waits on disk and fails nothing.
        write_text(a.output, f"{counts}\n")
        return 0
    return 1 if any(outcome.startswith(("unreachable", "damaged")) for outcome in outcomes) else 0


def compare_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring compare`."""
    add_results(parser)
    shared.add_settings(parser)
    about = "a commit, its first letters, HEAD~1, or a branch; a working copy with changes is ...-dirty"
    parser.add_argument("first", metavar="COMMIT_A", help=about)
    parser.add_argument("second", metavar="COMMIT_B")
    parser.add_argument("--output", type=Path, help="CSV file of the differences")


def compare(a: Namespace) -> None:
    """`neuspring compare`."""
    from neuspring.experiments.tracking.compare import compare

    settings = shared.read_settings(a.settings).tracking
    print(compare(a.results, settings, commit_named(a.first), commit_named(a.second), a.output), end="")


def ui_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring ui`."""
    add_results(parser)
    shared.add_settings(parser)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5000)


def ui(a: Namespace) -> None:
    """`neuspring ui`."""
    from neuspring.experiments.tracking.log import default_uri

    uri = shared.read_settings(a.settings).tracking.uri or default_uri(a.results)
    if uri.startswith("http"):
        print(f"The tracking server is at {uri}")
        return
    environment = os.environ | {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"}
    environment.setdefault("MLFLOW_SERVER_ENABLE_JOB_EXECUTION", "false")
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", a.host, "--port", str(a.port)]
    print(f"MLflow UI: http://{a.host}:{a.port} (stop with Ctrl-C)", flush=True)
    os.execve(sys.executable, command, environment)


def add_results(parser: ArgumentParser) -> None:
    """--results."""
    parser.add_argument("--results", type=Path, default=Path("results"), help="results folder")
