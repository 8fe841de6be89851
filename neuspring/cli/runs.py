"""Commands on MLflow, on sweeps, and on this machine: track-init, log, sync, compare, ui, tune, tune-report, doctor."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from neuspring.cli.options import Device, Positional, Results, Settings, arg, read_settings
from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.config import Config
    from neuspring.config.tuning import Tune

COMMIT = "a commit, its first letters, HEAD~1, or a branch; a working copy with changes is ...-dirty"


def track_init(output: Path, results: Results = Path("results"), settings: Settings = "{}") -> None:
    """Prepare the MLflow store, once before any run is logged."""
    from neuspring.core.files import write_text
    from neuspring.experiments.tracking import log

    outcome = log.init(results, read_settings(settings).tracking)
    write_text(output, json.dumps(outcome, indent=1, sort_keys=True) + "\n")
    print(f"MLflow: {outcome['outcome']}")


def log(
    record: Annotated[Path, arg(help="run.json")], output: Path, results: Results = Path("results"), settings: Settings = "{}"
) -> None:
    """Log one run.json to MLflow."""
    from neuspring.core.files import write_text
    from neuspring.experiments.tracking import log

    outcome = log.log_run(record, results, read_settings(settings).tracking)
    write_text(output, outcome + "\n")
    print(f"MLflow: {record}: {outcome}")


def sync(
    results: Results = Path("results"),
    settings: Settings = "{}",
    under: Annotated[Path | None, arg(help="only the records under this folder of the results")] = None,
    output: Annotated[Path | None, arg(help="file for the counts; failures are then not an error")] = None,
) -> int:
    """Send to MLflow what is missing there, and close runs that were killed; 1 where something could not be sent."""
    from neuspring.core.files import write_text
    from neuspring.experiments.tracking import log

    tracking = read_settings(settings).tracking
    log.init(results, tracking)
    outcomes = log.sync(results, tracking, progress=print, under=under)
    counts = "\n".join(f"{outcome}: {len(names)}" for outcome, names in outcomes.items())
    print(counts)
    if output:
        # A step of the workflow: what could not be sent waits on disk and fails nothing.
        write_text(output, f"{counts}\n")
        return 0
    return 1 if any(outcome.startswith(("unreachable", "damaged")) for outcome in outcomes) else 0


def compare(
    first: Annotated[Positional[str], arg(help=COMMIT)],
    second: Positional[str],
    results: Results = Path("results"),
    settings: Settings = "{}",
    output: Annotated[Path | None, arg(help="CSV file of the differences")] = None,
) -> None:
    """Runs of two commits, from MLflow -> paired differences."""
    from neuspring.core.provenance import commit_named
    from neuspring.experiments.tracking.compare import compare

    print(compare(results, read_settings(settings).tracking, commit_named(first), commit_named(second), output), end="")


def ui(results: Results = Path("results"), settings: Settings = "{}", host: str = "127.0.0.1", port: int = 5000) -> None:
    """Open the MLflow UI of a results folder."""
    from neuspring.experiments.tracking.store import default_uri

    uri = read_settings(settings).tracking.uri or default_uri(results)
    if uri.startswith("http"):
        print(f"The tracking server is at {uri}")
        return
    environment = os.environ | {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"}
    environment.setdefault("MLFLOW_SERVER_ENABLE_JOB_EXECUTION", "false")
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", host, "--port", str(port)]
    print(f"MLflow UI: http://{host}:{port} (stop with Ctrl-C)", flush=True)
    os.execve(sys.executable, command, environment)


def tune(
    observations: Annotated[tuple[Path, ...], arg(help="observations.npz of the sweep's scenarios")],
    output: Path,
    worker: int = 0,
    settings: Settings = "{}",
    device: Device = "auto",
    threads: int = 1,
) -> None:
    """One worker of a sweep."""
    from neuspring.experiments.tuning.worker import work

    work(*_sweep(settings), list(observations), worker, device, output)


def tune_report(output: Path, settings: Settings = "{}") -> None:
    """A sweep -> summary, plots, best.yaml."""
    from neuspring.experiments.tuning.report import report

    report(*_sweep(settings), output)
    print(output.read_text(encoding="utf-8"))


def _sweep(text: str) -> tuple[Config, Tune]:
    settings = read_settings(text)
    if settings.tune is None:
        raise InputError("--settings, tune", "a sweep is required", None, "See config/README.md, tune.")
    return settings, settings.tune


def doctor(settings: Settings = "{}") -> int:
    """Say what this machine can do, and what is missing; 1 where something that is configured cannot work."""
    from neuspring.experiments.doctor import examine, text

    findings = examine(read_settings(settings))
    print(text(findings))
    return int(any(finding.state == "broken" for finding in findings))
