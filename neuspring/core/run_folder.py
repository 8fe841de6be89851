"""The folder of a run, results/{scenario}/{method}/{seed}: which stages made it, and the files that their records name.

The one reader for scores, report, play, export and pictures. A run's stages may lie elsewhere in the scenario's folder, where
methods share them: a record names its inputs by digest, and `RunFolder.of` follows these.
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
"""Stages that produce a model, in order. A run's model is from the last of these that it has."""
RESULTS = ("twin", "model", "trajectory", "centers")
"""Roles of a stage's files that are results; its other files say how it got there."""
OBSERVATIONS_FILE = "observations.npz"


@dataclass(frozen=True)
class RunFolder:
    """The stages of a run by name, in their order."""

    folder: Path
    stages: Mapping[str, Before]

    @classmethod
    def of(cls, folder: Path, damaged: list[str] | None = None) -> RunFolder:
        """The run in a folder: its own records, and those that they were made from.

        What cannot be read raises InputError; with a list `damaged` the message goes there, and the rest is read.
        """
        folder, found = Path(folder).resolve(), dict[str, Before]()

        def add(find: Callable[[], Mapping[str, Before]]) -> None:
            try:
                found.update(find())
            except InputError as error:
                if damaged is None:
                    raise
                damaged.append(str(error))

        add(lambda: _own(folder, "rollout"))
        add(lambda: _behind(folder, found["rollout"].record) if "rollout" in found else _own(folder, *LEARNING_STAGES))
        add(lambda: _behind(folder, found["fit"].record) if "fit" in found else {})
        add(lambda: _own(folder, "render"))
        add(lambda: _splats(folder, found.get("render")))
        return cls(folder, {name: found[name] for name in (*LEARNING_STAGES, "rollout", "appearance", "render") if name in found})

    @property
    def scenario_folder(self) -> Path:
        """results/{scenario}."""
        return self.folder.parents[1]

    @property
    def records(self) -> dict[str, StageRecord]:
        """Stage -> record."""
        return {name: before.record for name, before in self.stages.items()}

    def file(self, stage: str, role: str) -> Path | None:
        """The file that a stage names; None if the run has no such stage or the stage no such file."""
        before = self.stages.get(stage)
        return before.file(role) if before and before.has(role) else None

    @property
    def learning(self) -> list[str]:
        """The stages that learned the run's model, in order."""
        return [name for name in LEARNING_STAGES if name in self.stages]

    @property
    def maker(self) -> StageRecord:
        """The stage that made the run's model; of what learns nothing, the rollout."""
        return self.stages[self.learning[-1] if self.learning else "rollout"].record

    @property
    def results(self) -> dict[str, str]:
        """Stage -> digest of its result."""
        return {name: before.record.files[role][1] for name, before in self.stages.items() for role in RESULTS if before.has(role)}

    @property
    def twin_file(self) -> Path | None:
        """The run's twin; None if it has none."""
        return self.file("fit" if "fit" in self.stages else "search", "twin")

    @cached_property
    def twin(self) -> Twin | None:
        """The twin, where the method has one."""
        return Twin.load(self.twin_file) if self.twin_file else None

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The prediction, where there is one."""
        path = self.file("rollout", "trajectory")
        return Trajectory.load(path) if path else None

    @cached_property
    def scores(self) -> pd.DataFrame:
        """Errors per task and metric, in the unit that each row names. Raises InputError if there are none."""
        import pandas as pd

        path = self.folder / "scores.parquet"
        if not path.is_file():
            raise InputError(path, "the scores of the run must be there", "no such file", "Run the workflow again.")
        return pd.read_parquet(path)

    def summary(self) -> pd.DataFrame:
        """Errors for reading: a row per metric and unit, a column per task; lengths in mm, with four significant digits.

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
        """Observations of the scenario. Raises InputError where they are missing, or others than the run was made from."""
        path = self.scenario_folder / OBSERVATIONS_FILE
        if not path.is_file():
            raise InputError(
                path, "the observations of the run must be there", "no such file", "Use the results folder it was made in."
            )
        made_from = {before.record.inputs.get("observations") for before in self.stages.values()} - {None}
        if made_from and digest_file(path) not in made_from:
            raise InputError(path, f"must be what {self.folder} was made from", "other content", "Run the workflow again.")
        return Observations.load(path)


def _own(folder: Path, *names: str) -> dict[str, Before]:
    """The stages of these names whose records lie in the run's own folder."""
    return {name: Before.load(path) for name in names if (path := folder / f"{name}.json").is_file()}


def _behind(folder: Path, record: StageRecord) -> dict[str, Before]:
    """The learning stages that a record names as inputs, wherever in the scenario's folder they lie."""
    wanted = {record.inputs[role] for role in ("learned", *LEARNING_STAGES) if role in record.inputs}
    found: dict[str, Before] = {}
    for name in LEARNING_STAGES:
        for path in (folder / f"{name}.json", *sorted(folder.parents[1].glob(f"*/*/{name}.json"))):
            if name not in found and path.is_file() and digest_file(path) in wanted:
                found[name] = Before.load(path)
    if wanted and not found:
        rule = f"the record of its model must lie in {folder.parents[1]}, unchanged since {record.stage} was made"
        raise InputError(folder, rule, "none", "Use the results folder in which the run was made.")
    return found


def _splats(folder: Path, render: Before | None) -> dict[str, Before]:
    """The splats of the run's pictures, else those of its seed, if there are any."""
    records = sorted(folder.parents[1].glob("appearance*/*/appearance.json"))
    if render:
        records = [path for path in records if digest_file(path) == render.record.inputs.get("appearance")]
    else:
        records = [path for path in records if path.parts[-3:-1] == ("appearance", folder.name)]
    usable = [before for before in map(Before.load, records) if before.record.status == "ok"]
    return {"appearance": usable[0]} if usable else {}
