"""The command lines of jobs that look at many runs: tables, studies, report, sweeps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from neuspring.config import plain
from neuspring.config.settings import select
from neuspring.core.errors import InputError
from neuspring.experiments.benchmark import Benchmark, read_methods, read_searches

TEMPLATES = Path(__file__).parents[1] / "report" / "templates"


class Arguments:
    """Arguments of the commands, for the whole of one benchmark, whatever part runs now."""

    def __init__(self, benchmark: Benchmark, root: Path) -> None:
        self._benchmark, self._root = benchmark, root
        self._config, self._whole = benchmark.config, benchmark.whole
        self.folder = f"{self._config.results}/{self._config.tables}"
        tune = self._config.tune
        self.sweep_folder = f"{self._config.results}/tune/{tune.study}" if tune else ""

    def tables(self, output: str = "") -> list[str]:
        """Of `neuspring tables`; into `output` instead of the folder of tables."""
        return [
            *(*self._runs(output or self.folder), *self._transfers(), "--baseline", self._benchmark.compared_with),
            *self._judged(),
        ]

    def study(self, name: str) -> list[str]:
        """Of `neuspring study`."""
        return ["--study", name, "--table", str(self._root / self._config.study_table), *self._runs(f"{self.folder}/studies")]

    def perception(self, categories: Mapping[str, str]) -> list[str]:
        """Of `neuspring perception-table`, from the categories of the scenarios whose truth is known."""
        return ["--results", self._config.results, "--scenarios", json.dumps(categories)]

    def report(self, output: str = "") -> list[str]:
        """Of `neuspring report`; to the file `output` instead of the one in the folder of tables."""
        values = plain(self._whole) | {"only": ""}
        # Where MLflow lies concerns nothing that the report shows.
        del values["tracking"]
        return [
            *("--results", self._config.results, "--output", output or f"{self.folder}/report.html"),
            *("--settings", json.dumps(values, sort_keys=True)),
            *("--table", str(self._root / self._config.study_table), "--tables", self._config.tables),
            *("--baseline", self._benchmark.compared_with),
            *self._transfers(),
            *self._left_out(),
        ]

    def _runs(self, output: str) -> list[str]:
        """The results folder and the full list of its runs, whatever part runs now."""
        whole = self._whole
        return [
            *("--results", self._config.results, "--output", output),
            *("--scenarios", *whole.scenarios),
            *("--methods", *whole.methods, "--seeds", *map(str, whole.seeds)),
            *self._left_out(),
        ]

    def _transfers(self) -> list[str]:
        sources = [name for name in self._whole.transfers or {} if name in self._whole.scenarios]
        return ["--transfers", *sources] if sources else []

    def _judged(self) -> list[str]:
        """What ratios are over, and aims; nothing where there is nothing to say."""
        objects = [] if self._config.objects == "scenario" else ["--objects", self._config.objects]
        return [*objects, *(["--aims", json.dumps(plain(self._config)["aims"])] if self._config.aims else [])]

    def _left_out(self) -> list[str]:
        """Which methods do not apply to which scenarios, so that nothing is missing there."""
        left_out = self._benchmark.whole_left_out
        return ["--left-out", json.dumps(left_out, sort_keys=True)] if left_out else []

    @staticmethod
    def template_digest() -> str:
        """Digest of the report's templates, which the digest of its code does not hold."""
        texts = [path.read_bytes() for path in sorted(TEMPLATES.iterdir())]
        return hashlib.sha256(b"".join(texts)).hexdigest()[:16]

    def finished_sweeps(self) -> list[str]:
        """Digest of the sweep's summary, if it is there.

        A sweep costs much: it is no input of the report, so that changed settings do not run it again.
        """
        path = Path(self.sweep_folder) / "summary.md"
        return [hashlib.sha256(path.read_bytes()).hexdigest()[:16]] if self.sweep_folder and path.exists() else []

    def sweep_targets(self) -> list[str]:
        """Files of the target `sweep`. Raises InputError if the configuration has none."""
        if not self.sweep_folder:
            remedy = "Add the section `tune` (config/README.md, config/studies/tune.yaml)."
            raise InputError("configuration, tune", "the target sweep needs a sweep", None, remedy)
        logged = [f"{self.sweep_folder}/mlflow.txt"] if self._config.tracking.enabled else []
        return [f"{self.sweep_folder}/summary.md", *logged]

    def sweep(self) -> str:
        """Settings of a sweep's workers, as JSON; its tables of methods and searches are found wherever a job runs."""
        values = select(self._config, ("simulation", "losses", "search", "fit", "released_quirks", "tune"))
        tables = {name: str(self._root / getattr(self._config, name)) for name in ("method_table", "search_table")}
        return json.dumps(values | tables | {"scenarios": list(self._whole.scenarios)}, sort_keys=True)

    def tuned_rows(self) -> str:
        """The rows of the method that is varied, so that changed ones are tuned again."""
        tune = self._config.tune
        assert tune
        method = read_methods(self._root / self._config.method_table)[tune.method]
        search = read_searches(self._root / self._config.search_table)[method.search or ""]
        return json.dumps([plain(method), plain(search)], sort_keys=True)
