"""How long a job takes to start, and what 16 jobs that start at once compile: python -m tests.benchmarks.bench_start

A rollout of a tiny scene, whose own work is negligible: with warm kernels alone, then 16 at once with an empty kernel cache.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ONE = """import sys
from neuspring.cli.main import main
from neuspring.core import device
device.quiet = lambda: None
sys.exit(main())"""
"""A command whose Warp says which modules it compiled and which it found."""


def tiny(folder: Path) -> list[str]:
    """The command line of a rollout of a tiny scene, made here."""
    settings = {"toy": {"frames": 5}, "search": {"rollouts": 2}}
    (folder / "settings.yaml").write_text(json.dumps(settings))
    run = [sys.executable, "-m", "neuspring"]
    options = ["--settings", str(folder / "settings.yaml")]
    observations, search = folder / "observations.npz", folder / "search.json"
    make = ["observe", "--scenario", "toy_rope_lift_smooth", *options, "--output", str(observations)]
    subprocess.run([*run, *make], check=True, stdout=subprocess.DEVNULL)
    make = ["search", "--observations", str(observations), *options, "--device", "cpu", "--output", str(search)]
    subprocess.run([*run, *make], check=True, capture_output=True)
    return ["rollout", "--observations", str(observations), "--learned", str(search), "--device", "cpu", "--output"]


def alone(folder: Path, command: list[str], times: int) -> list[float]:
    """Seconds of a job from start to end, alone on the machine and with warm kernels, each time."""
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        run = [sys.executable, "-m", "neuspring", *command, str(folder / "alone.json")]
        subprocess.run(run, check=True, capture_output=True)
        seconds.append(time.perf_counter() - start)
    return seconds


def crowd(folder: Path, command: list[str], jobs: int = 16) -> tuple[float, str]:
    """Seconds until all of `jobs` that start at once with an empty kernel cache have ended, and what they printed."""
    environment = os.environ | {"WARP_CACHE_PATH": str(folder / "cache")}
    start = time.perf_counter()
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", ONE, *command, str(folder / f"{index}.json")],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        for index in range(jobs)
    ]  # fmt: skip
    outputs = [process.communicate()[0] for process in processes]
    assert all(process.returncode == 0 for process in processes), outputs[0]
    return time.perf_counter() - start, "".join(outputs)


def main() -> None:
    """Print both."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        command = tiny(folder)
        times = alone(folder, command, 5)
        spread = f"{min(times):.1f} to {max(times):.1f}"
        print(f"a job alone, warm kernels: {statistics.median(times):.1f} s from start to end ({spread})")
        took, text = crowd(folder, command)
        compiled, found = text.count("(compiled)"), text.count("(cached)")
        print(f"16 at once, no kernels: {took:.1f} s; {compiled} compiled, {found} found in the cache")


if __name__ == "__main__":
    main()
