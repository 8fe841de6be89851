"""The folder of a run, results/{scenario}/{method}/{seed}: its stages, and the files that their records name.

Scores, report, play, exports and figures read runs only through this module. Methods share stages, so a stage's record may be in
another folder of the scenario: records name their inputs by digest, and `RunFolder.of` follows these digests.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.core.records import Before, StageRecord, digest_file
from neuspring.core.text import readable

if TYPE_CHECKING:
    import pandas as pd

LEARNING_STAGES = ("search", "fit", "train")
"""Stages that produce a model, in order. A run's model comes from the last of them that the run has."""
RESULTS = ("twin", "model", "trajectory", "centers")
"""Roles of files that are results; other files describe how a stage obtained them."""
OBSERVATIONS_FILE = "observations.npz"


@dataclass(frozen=True)
class RunFolder:
    """The stages of a run by name, in their order."""

    folder: Path
    stages: Mapping[str, Before]

    @classmethod
    def of(cls, folder: Path, damaged: list[str] | None = None) -> RunFolder:
        """Read the run in a folder: its own records, and the records of their inputs.

        Raises InputError for unreadable records; with a list `damaged`, the messages are appended there instead.
        """
        folder, stages = Path(folder).resolve(), dict[str, Before]()

        def add(find: Callable[[], Mapping[str, Before]]) -> None:
            try:
                stages.update(find())
            except InputError as error:
                if damaged is None:
                    raise
                damaged.append(str(error))

        add(lambda: _own(folder, "rollout"))
        add(lambda: _learned(folder, stages["rollout"].record) if "rollout" in stages else _own(folder, *LEARNING_STAGES))
        add(lambda: _learned(folder, stages["fit"].record) if "fit" in stages else {})
        add(lambda: _own(folder, "render"))
        add(lambda: _splats(folder, stages.get("render")))
        return cls(folder, {name: stages[name] for name in (*LEARNING_STAGES, "rollout", "appearance", "render") if name in stages})

    @property
    def scenario_folder(self) -> Path:
        """results/{scenario}."""
        return self.folder.parents[1]

    @property
    def records(self) -> dict[str, StageRecord]:
        """Stage -> record."""
        return {name: before.record for name, before in self.stages.items()}

    def file(self, stage: str, role: str) -> Path | None:
        """The file of a stage and role; None if the run has no such stage or the stage has no such file."""
        before = self.stages.get(stage)
        return before.file(role) if before and before.has(role) else None

    @property
    def learning(self) -> list[str]:
        """Names of the stages that learned the run's model, in order."""
        return [name for name in LEARNING_STAGES if name in self.stages]

    @property
    def maker(self) -> StageRecord:
        """The record of the stage that made the run's model; for methods that learn nothing, of the rollout."""
        return self.stages[self.learning[-1] if self.learning else "rollout"].record

    @property
    def results(self) -> dict[str, str]:
        """Stage -> digest of its result."""
        return {name: before.record.files[role][1] for name, before in self.stages.items() for role in RESULTS if before.has(role)}

    @property
    def twin_file(self) -> Path | None:
        """The file of the run's twin; None if it has none."""
        return self.file("fit" if "fit" in self.stages else "search", "twin")

    @cached_property
    def twin(self) -> Twin | None:
        """The twin; None if the method has none."""
        return Twin.load(self.twin_file) if self.twin_file else None

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The prediction; None if there is none."""
        path = self.file("rollout", "trajectory")
        return Trajectory.load(path) if path else None

    @cached_property
    def scores(self) -> pd.DataFrame:
        """Errors per task and metric, in the unit of each row. Raises InputError if the file is missing."""
        import pandas as pd

        path = self.folder / "scores.parquet"
        if not path.is_file():
            raise InputError(path, "the scores of the run must exist", "no such file", "Rerun the workflow.")
        return pd.read_parquet(path)

    def summary(self) -> pd.DataFrame:
        """Errors for display: one row per metric and unit, one column per task; lengths in mm, four significant digits.

        Raises InputError if there are no scores.
        """
        scores = self.scores
        value, unit = zip(*map(readable, scores["value"], scores["unit"]), strict=True) if len(scores) else ((), ())
        table = scores.assign(value=value, unit=unit)
        rows = dict.fromkeys(zip(table["metric"], table["unit"], strict=True))
        wide = table.pivot(index=["metric", "unit"], columns="task", values="value")
        return wide.reindex(index=list(rows), columns=list(dict.fromkeys(table["task"])))

    @cached_property
    def observations(self) -> Observations:
        """Observations of the scenario. Raises InputError if they are missing or differ from the run's inputs."""
        path = self.scenario_folder / OBSERVATIONS_FILE
        if not path.is_file():
            raise InputError(path, "the observations of the run must exist", "no such file", "Use the run's own results folder.")
        made_from = {before.record.inputs.get("observations") for before in self.stages.values()} - {None}
        if made_from and digest_file(path) not in made_from:
            raise InputError(path, f"must be the observations of {self.folder}", "other content", "Rerun the workflow.")
        return Observations.load(path)


def _own(folder: Path, *names: str) -> dict[str, Before]:
    """The stages of these names whose records are in the run's own folder."""
    return {name: Before.load(path) for name in names if (path := folder / f"{name}.json").is_file()}


def _learned(folder: Path, record: StageRecord) -> dict[str, Before]:
    """The learning stages that a record has as inputs, from any folder of the scenario."""
    digests = {record.inputs[role] for role in ("learned", *LEARNING_STAGES) if role in record.inputs}
    stages: dict[str, Before] = {}
    for name in LEARNING_STAGES:
        for path in (folder / f"{name}.json", *sorted(folder.parents[1].glob(f"*/*/{name}.json"))):
            if name not in stages and path.is_file() and digest_file(path) in digests:
                stages[name] = Before.load(path)
    if digests and not stages:
        rule = f"the record of its model must be in {folder.parents[1]}, unchanged after {record.stage}"
        raise InputError(folder, rule, "none", "Use the run's own results folder.")
    return stages


def _splats(folder: Path, render: Before | None) -> dict[str, Before]:
    """The splats from which the run was rendered; without a rendering, the splats of its seed, if they exist."""
    records = sorted(folder.parents[1].glob("appearance*/*/appearance.json"))
    if render:
        records = [path for path in records if digest_file(path) == render.record.inputs.get("appearance")]
    else:
        records = [path for path in records if path.parts[-3:-1] == ("appearance", folder.name)]
    usable = [before for before in map(Before.load, records) if before.record.status == "ok"]
    return {"appearance": usable[0]} if usable else {}
