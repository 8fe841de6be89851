"""Jobs over many runs: tables, study, page (the report), perception_table, and the jobs of a sweep.

They cover the complete configuration, independent of `only`. `study` and `page` read the output of `tables`, or the runs.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuspring.config import plain
from neuspring.core.errors import InputError
from neuspring.core.provenance import code_digest, file_stamp
from neuspring.experiments.graph import Graph, Unit
from neuspring.registry import modules

TEMPLATES = Path(__file__).parents[1] / "report" / "templates"
FILE_OPTIONS = ("results", "output", "table", "method_table", "extra_rows", "observations")
"""Options that are paths; digests cover the content of these files instead."""
RULES = {"tables": 10, "study": 10, "page": 20, "perception_table": 10, "tune": 2880, "sweep_report": 20}
"""Rule -> maximum duration of a job, minutes."""


class Tasks:
    """Units of rules without stages; `commands`: name -> function that they call.

    `sweeps`: the module with the jobs of sweeps; None if its extension was removed.
    """

    def __init__(self, graph: Graph, commands: Mapping[str, Callable[..., Any]], sweeps: Any = None) -> None:
        self.commands, self.sweeps = commands, sweeps
        self.graph, self.config, self.whole, self.known = graph, graph.config, graph.whole, graph.benchmark
        self.root, self.results = graph.benchmark.root, Path(graph.results)
        self.folder = self.results / self.config.tables
        """Folder of tables and report."""
        graph.tasks = {name: getattr(self, name) for name in RULES}

    # --- tables and pages

    def tables(self, name: str = "all") -> Unit:
        """The long table of all scores, and the summary."""
        given: dict[str, Any] = {"output": self.folder, "baseline": self.known.compared_with, **self._runs(), **self._transfers()}
        given |= {"aims": json.dumps(plain(self.config)["aims"]), "objects": self.config.objects}
        given |= self._rows(method_table=self.config.method_table)
        files = [self.folder / "summary.md", self.folder / "scores.csv"]
        return self._unit("tables", name, given, self.graph.runs(), ("report.tables",), files)

    def perception_table(self, name: str = "all") -> Unit:
        """Errors of perception by category."""
        judged = self.graph.judged(self.whole.scenarios)
        output = self.folder / "perception.md"
        given: dict[str, Any] = {"output": output, "scenarios": json.dumps(judged)}
        needs = [self.graph.unit("perceive", scenario) for scenario in self.graph.judged(self.config.scenarios)]
        return self._unit("perception_table", name, given, needs, ("report.perception",), [output])

    def study(self, name: str) -> Unit:
        """One of the paper's tables."""
        given: dict[str, Any] = {"study": name, "tables": self.config.tables, "output": self.folder / "studies"}
        given |= self._rows(table=self.config.study_table)
        given |= {"left_out": json.dumps(self.known.whole_left_out)}
        also = json.dumps(plain(self.known.studies[name]))
        needs = [self.graph.unit("tables", "all")]
        return self._unit("study", name, given, needs, ("report.study",), [given["output"] / f"{name}.md"], also)

    def page(self, name: str = "all") -> Unit:
        """The report page."""
        settings = plain(self.whole) | {"only": ""}
        # The report does not depend on the locations of MLflow and of the results.
        del settings["tracking"], settings["results"]
        given: dict[str, Any] = {
            "output": self.folder / "report.html",
            "settings": json.dumps(settings, sort_keys=True),
            **self._rows(table=self.config.study_table, method_table=self.config.method_table),
            "tables": self.config.tables,
        }
        given |= {"baseline": self.known.compared_with, **self._transfers(), "left_out": json.dumps(self.known.whole_left_out)}
        sections = [text.partition(":")[0].removeprefix("neuspring.") for text in modules("neuspring.report.sections").values()]
        also = "".join(file_stamp(path) for path in sorted(TEMPLATES.iterdir()))
        return self._unit("page", name, given, self.shown(), ("report.page", *sections), [given["output"]], also)

    def shown(self, studies: Iterable[str] | None = None) -> list[Unit]:
        """The units whose results the report shows, except runs."""
        units = [self.graph.unit("tables", "all")]
        units += [self.graph.unit("study", name) for name in (self.config.studies if studies is None else studies)]
        return units + ([self.graph.unit("perception_table", "all")] if self.graph.judged(self.config.scenarios) else [])

    def so_far(self, folder: Path) -> Path:
        """Make tables and report of the finished runs in `folder`; returns the path of the page."""
        unit, page = self.graph.unit("tables", "all"), self.graph.unit("page", "all")
        self._call("tables", dict(unit.options) | {"output": folder, "brief": True})
        self._call(
            "report", dict(page.options) | {"output": folder / "report.html", "tables": f"{self.config.tables}/{folder.name}"}
        )
        return folder / "report.html"

    def _runs(self) -> dict[str, Any]:
        names = {name: tuple(getattr(self.whole, name)) for name in ("scenarios", "methods", "seeds")}
        return names | {"left_out": json.dumps(self.known.whole_left_out)}

    def _rows(self, **tables: str) -> dict[str, Any]:
        return {name: self.root / path for name, path in tables.items()} | {"extra_rows": tuple(self.known.extra)}

    def _transfers(self) -> dict[str, Any]:
        return {"transfers": tuple(name for name in self.whole.transfers or {} if name in self.whole.scenarios)}

    # --- a sweep: workers share one Optuna study, whose number of trials does not depend on the number of workers

    def tune(self, name: str) -> Unit:
        """A worker of the sweep."""
        jobs, folder = self._tuning()
        needs = [self.graph.unit("perceive", scenario) for scenario in self.known.tuned]
        given: dict[str, Any] = {
            "observations": tuple(self.results / scenario / "observations.npz" for scenario in self.known.tuned)
        }
        given |= {"settings": jobs.settings(self.known), "worker": int(name), "output": folder / f"worker-{name}.json"}
        code = (f"{jobs.__package__}.trial",)
        return self._unit("tune", name, given, needs, code, [given["output"]], jobs.rows(self.known), where=("device", "threads"))

    def sweep_report(self, name: str = "all") -> Unit:
        """The results of the sweep. Raises InputError if the configuration contains no sweep."""
        jobs, folder = self._tuning()
        assert self.config.tune
        given: dict[str, Any] = {"settings": jobs.settings(self.known), "output": folder / "summary.md"}
        workers = [self.graph.unit("tune", str(worker)) for worker in range(self.config.tune.workers)]
        return self._unit("sweep_report", name, given, workers, (f"{jobs.__package__}.report",), [given["output"]])

    def _tuning(self) -> tuple[Any, Path]:
        if not self.config.tune:
            remedy = "Add the section `tune` (config/README.md, config/studies/tune.yaml)."
            raise InputError("configuration, tune", "is required for the target sweep", None, remedy)
        if self.sweeps is None:
            rule, remedy = "requires the extension neuspring/extensions/tuning", "Restore its folder, or remove `tune`."
            raise InputError("configuration, tune", rule, "a removed extension", remedy)
        return self.sweeps, self.results / "tune" / self.config.tune.study

    # --- common parts

    def _unit(
        self,
        rule: str,
        name: str,
        given: Mapping[str, Any],
        needs: Sequence[Unit],
        code: Iterable[str],
        files: Sequence[Path],
        also: str = "",
        where: Sequence[str] = (),
    ) -> Unit:
        plain_options = {key: value for key, value in given.items() if key not in FILE_OPTIONS}
        tables = [file_stamp(path) for key in ("table", "method_table") if (path := given.get(key))]
        tables += [file_stamp(path) for path in given.get("extra_rows", ())]
        digest = code_digest(*(module if module.startswith("neuspring.") else f"neuspring.{module}" for module in code))
        inputs = [unit.digest for unit in needs]
        made_of = {rule: {"options": plain_options, "code": digest, "data": [*tables, also], "inputs": inputs}}
        command = {"page": "report", "sweep_report": "tune-report"}.get(rule, rule.replace("_", "-"))
        options = dict(given) if rule in ("tune", "sweep_report") else {"results": self.results, **given}

        def run(places: Mapping[str, Any]) -> Sequence[Path]:
            self._call(command, options | {key: places[key] for key in where})
            return files

        return Unit(rule=rule, name=name, needs=needs, made_of=made_of, run=run, options=options)

    def _call(self, command: str, options: Mapping[str, Any]) -> None:
        self.commands[command](**options)
