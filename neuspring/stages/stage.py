"""What a stage of the workflow is: one typed function.

The signature says what it reads, and from it and the decorator `stage` everything else follows: the command and its options, the
rule, the digests of the inputs and the settings in the record, the passing on of failures.

| a parameter of type | is |
|---|---|
| `Observations`, `Capture` | a file of an earlier stage, which the function gets loaded |
| `Before` | the record of an earlier stage; one that failed ends this stage with the same reason, unless it is `MayFail` |
| a sequence of these | such files of all cameras, or of several recordings |
| `Config` | the settings: those of `reads` are given to the rule and stand in the record |
| `Recorder` | the record to be; a stage without one writes its product itself, which is its parameter `output` |
| `device`, `threads`, `twins_per_launch` | where and how it runs, which changes no result and stands in no record |
| anything else | an option of the command, which stands in the record |

An input has the name of the file that it is: `masks` is the masks.json that stage `segment` writes, `search` a search.json.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from neuspring import config
from neuspring.config import Config, ScenarioRow
from neuspring.config.settings import select
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import CAPTURE, Capture

PLACES = ("device", "threads", "twins_per_launch")
"""Parameters that say where and how a stage runs."""
Reads = Callable[[Config, Mapping[str, Any]], Sequence[str]]
"""From the settings and the values of all parameters."""


MAY_FAIL = "may have failed"
MayFail = Annotated[Before, MAY_FAIL]
"""A record that the function wants also of a stage that failed."""


def paths(records: Iterable[Before]) -> list[Path]:
    """Where the records are."""
    return [before.path for before in records]


def require_length(capture: Capture, observations: Observations) -> None:
    """Raise InputError unless a capture and its observations have as many frames."""
    if capture.frame_count != observations.scenario.frame_count:
        rule = f"must have as many frames as the observations: {observations.scenario.frame_count}"
        remedy = "Correct the data, or set images.enabled: false to go without pictures."
        raise InputError(capture.folder / CAPTURE, rule, capture.frame_count, remedy)


@dataclass(frozen=True, kw_only=True)
class Written:
    """What a stage has made, for its record."""

    files: Mapping[str, Path] = field(default_factory=dict)
    """Role -> file beside the record."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Numbers and text worth keeping."""
    failure: str = ""
    """Why the stage failed, where it left files nevertheless."""
    attempts: int = 1
    earlier_seconds: float = 0.0
    """Of the attempts that it continued."""
    checkpoint: Path | None = None
    """No longer needed once the record is there."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a stage: an input file, an option, or where it runs."""

    name: str
    type: Any
    """Without what says that it may be left out."""
    default: Any
    note: str = ""
    """The text beside the type, for the help of the command."""

    @property
    def many(self) -> bool:
        """Whether it is a sequence."""
        return typing.get_origin(self.type) is Sequence

    @property
    def one(self) -> Any:
        """Its type, or that of its entries."""
        return typing.get_args(self.type)[0] if self.many else self.type

    @property
    def is_input(self) -> bool:
        """Whether it names files."""
        return self.one in LOADERS

    @property
    def required(self) -> bool:
        """Whether it must be given."""
        return self.default is inspect.Parameter.empty


LOADERS: dict[Any, Callable[[Path], Any]] = {
    Observations: Observations.load,
    Capture: lambda path: Capture.load(path.parent),
    Before: Before.load,
}


@dataclass(frozen=True)
class Job:
    """A stage with everything that it was given."""

    stage: Stage
    arguments: dict[str, Any]
    """Of the function."""
    record: Recorder | None

    @property
    def failed(self) -> Before | None:
        """The first input whose failure is passed on."""
        for name, parameter in self.stage.inputs.items():
            value = self.arguments[name]
            for before in value if parameter.many else [value]:
                if isinstance(before, Before) and before.record.status == "failed" and name not in self.stage.may_fail:
                    return before
        return None


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage, called with the paths of its inputs, its options and `output`."""

    function: Callable[..., Any]
    output: str
    """The file that it writes below the results folder, with the job's wildcards."""
    reads: tuple[str, ...] | Reads = ()
    """Keys of the settings that it reads."""
    code: Callable[[Config, Mapping[str, Any]], Sequence[str]] = lambda settings, values: ()
    """Modules that it imports by name: backends, readers, baselines."""
    gpu: Literal["never", "backend", "always"] = "never"
    """Whether its jobs take a GPU where there is one; `backend`: its backend decides."""
    memory_mb: int = 4000
    minutes: int = 30
    """What its first jobs ask for, before any was measured."""

    @property
    def name(self) -> str:
        """The name of its rule and its command."""
        return self.function.__name__

    @property
    def about(self) -> str:
        """What it makes of what, in a line."""
        return (inspect.getdoc(self.function) or "").partition("\n")[0].partition(": ")[0].rstrip(".")

    @property
    def product(self) -> str:
        """The name under which later stages take what it writes."""
        return Path(self.output).stem

    @property
    def wildcards(self) -> tuple[str, ...]:
        """What tells its jobs apart."""
        return tuple(re.findall(r"{(\w+)}", self.output))

    @property
    def job_name(self) -> str:
        """The pattern that names its jobs in logs and job records."""
        return "/".join(f"{{{name}}}" for name in self.wildcards)

    @cached_property
    def _hints(self) -> dict[str, Any]:
        return typing.get_type_hints(self.function, include_extras=True)

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """All parameters but the settings and the record."""
        found = {}
        for name, declared in inspect.signature(self.function).parameters.items():
            hint, note = self._hints[name], ""
            if typing.get_origin(hint) in (typing.Union, types.UnionType):
                parts = [part for part in typing.get_args(hint) if part is not types.NoneType]
                hint = parts[0] if len(parts) == 1 else hint
            if typing.get_origin(hint) is Annotated:
                hint, note = typing.get_args(hint)[:2]
            if hint not in (Config, Recorder):
                found[name] = Parameter(name, hint, declared.default, note)
        return found

    @cached_property
    def inputs(self) -> dict[str, Parameter]:
        """The files that it reads."""
        return {name: parameter for name, parameter in self.parameters.items() if parameter.is_input}

    @cached_property
    def options(self) -> dict[str, Parameter]:
        """What it is told beside files and settings."""
        return {n: p for n, p in self.parameters.items() if not p.is_input and n not in (*PLACES, "output")}

    @cached_property
    def places(self) -> tuple[str, ...]:
        """Which of `PLACES` it takes."""
        return tuple(name for name in PLACES if name in self.parameters)

    @cached_property
    def may_fail(self) -> frozenset[str]:
        """Inputs that it wants also where they failed."""
        return frozenset(name for name, parameter in self.inputs.items() if parameter.note == MAY_FAIL)

    @property
    def _settings(self) -> str | None:
        return next((name for name, hint in self._hints.items() if hint is Config), None)

    @property
    def _record(self) -> str | None:
        return next((name for name, hint in self._hints.items() if hint is Recorder), None)

    def settings(self, values: Config, given: Mapping[str, Any]) -> dict[str, Any]:
        """The part of the settings that the stage reads, given these values of its parameters."""
        keys = self.reads(values, given) if callable(self.reads) else self.reads
        return select(values, keys)

    def job(self, *, output: Path, settings: Config | None = None, **given: Any) -> Job:
        """Load the inputs, digest them, begin the record. Raises InputError for what is missing, unknown or damaged."""
        unknown = sorted(set(given) - set(self.parameters))
        missing = [n for n, p in self.parameters.items() if p.required and n not in given and n != "output"]
        if unknown or missing:
            raise InputError(f"stage {self.name}", f"takes {', '.join(self.parameters)}", f"missing {missing}, unknown {unknown}")
        values = {name: given.get(name, parameter.default) for name, parameter in self.parameters.items() if name != "output"}
        if "device" in values:
            from neuspring.core.device import resolve_device

            values["device"] = resolve_device(values["device"])
        paths = dict(self._paths(values))
        settings = settings or Config()
        record = None
        if self._record:
            told = {name: values[name] for name in self.options}
            record = Recorder(
                self.name,
                output,
                inputs=paths,
                settings=self.settings(settings, values) | told,
                device=values.get("device", "cpu"),
            )
        for name, parameter in self.inputs.items():
            if parameter.many:
                values[name] = [LOADERS[parameter.one](Path(path)) for path in values[name] or ()]
            elif values[name] is not None:
                values[name] = LOADERS[parameter.one](Path(values[name]))
        extra = {self._settings: settings, self._record: record, "output": output if "output" in self.parameters else None}
        return Job(self, values | {name: value for name, value in extra.items() if name and value is not None}, record)

    def _paths(self, values: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
        for name, parameter in self.inputs.items():
            if parameter.many:
                yield from ((f"{name}{place}", Path(path)) for place, path in enumerate(values[name] or ()))
            elif values[name] is not None:
                yield name, Path(values[name])

    def __call__(self, *, output: Path, settings: Config | None = None, **given: Any) -> None:
        """Run it, and write its record. A numerical failure is recorded, its own or that of an earlier stage."""
        job = self.job(output=Path(output), settings=settings, **given)
        record = job.record
        if record is None:
            self.function(**job.arguments)
            return
        if failed := job.failed:
            reason = failed.record.reason.removeprefix(f"{failed.record.stage}: ")
            record.save(failure=f"{failed.record.stage}: {reason}")
            return
        try:
            made = self.function(**job.arguments)
        except NumericalFailure as failure:
            record.save(failure=str(failure))
            return
        record.save(made.files, made.facts, failure=made.failure, attempts=made.attempts, earlier_seconds=made.earlier_seconds)
        if made.checkpoint:
            made.checkpoint.unlink(missing_ok=True)

    # --- its command

    def words(self, given: Mapping[str, Any]) -> list[str]:
        """The command line of these values; the opposite of `parse`."""
        words: list[str] = []
        for name, value in given.items():
            parameter, option = self.parameters.get(name), f"--{name.replace('_', '-')}"
            if value is None or value is False or (parameter and parameter.many and not value):
                continue
            if value is True:
                words.append(option)
            elif parameter and parameter.many:
                words += [option, *map(str, value)]
            else:
                words += [
                    option,
                    value
                    if isinstance(value, str)
                    else json.dumps(value, sort_keys=True)
                    if isinstance(value, dict | list)
                    else str(value),
                ]
        return words

    def parse(self, words: Sequence[str]) -> dict[str, Any]:
        """Values of a command line, as `__call__` takes them. Raises InputError, and SystemExit for words that are no options."""
        import tyro

        pairs = (tyro.conf.FlagCreatePairsOff,)

        fields: list[Any] = []
        for name, parameter in self.parameters.items():
            kind, default = _typed(parameter)
            note = tyro.conf.arg(help=parameter.note or _about(parameter))
            spec = (name, Annotated[kind, note])
            fields.append(spec if default is dataclasses.MISSING else (*spec, dataclasses.field(default=default)))
        if "output" not in self.parameters:
            fields.append(("output", Annotated[Path, tyro.conf.arg(help=f"{Path(self.output).name} to write")]))
        if self._settings:
            note = tyro.conf.arg(help="JSON, or YAML files separated by commas; defaults otherwise")
            fields.append(("settings", Annotated[str, note], dataclasses.field(default="{}")))
        made = dataclasses.make_dataclass(self.name, fields, kw_only=True)
        about = f"{self.about}."
        read = dataclasses.asdict(tyro.cli(made, args=list(words), prog=f"neuspring {self.name}", description=about, config=pairs))
        if "settings" in read:
            read["settings"] = read_settings(read["settings"])
        for name, parameter in self.parameters.items():
            if parameter.type is ScenarioRow:
                read[name] = read_row(read[name], read.get("settings") or Config())
            elif _is_json(parameter):
                read[name] = json_value(f"--{name}", read[name])
            elif parameter.many:
                read[name] = list(read[name])
        return read


def stage(output: str, **declared: Any) -> Callable[[Callable[..., Any]], Stage]:
    """The decorator of a stage; see `Stage` for what is declared."""
    return lambda function: Stage(function, output, **declared)


def _is_json(parameter: Parameter) -> bool:
    return parameter.type is dict or typing.get_origin(parameter.type) is dict


def _typed(parameter: Parameter) -> tuple[Any, Any]:
    """The type of an option of the command, and its default."""
    kind: Any = Path if parameter.is_input else parameter.one
    if parameter.type is ScenarioRow or _is_json(parameter):
        kind = str
    if parameter.many:
        kind = tuple[kind, ...]
        return kind, dataclasses.MISSING if parameter.required else ()
    if parameter.required:
        return kind, dataclasses.MISSING
    if parameter.default is None:
        return kind | None, None
    return kind, parameter.default


def _about(parameter: Parameter) -> str:
    if parameter.type is ScenarioRow:
        return "a row of the scenario table, by its name or as JSON"
    if not parameter.is_input:
        return ""
    name = f"{parameter.name}.json" if parameter.one is Before else {Capture: "capture.json"}.get(parameter.one, "observations.npz")
    return name + (" of every camera, in their order" if parameter.one is Before and parameter.many else "")


def read_settings(text: str) -> Config:
    """Settings from JSON text, or from YAML files separated by commas (later ones override). Raises InputError."""
    if text.lstrip().startswith("{"):
        return config.parse(Config, json_value("--settings", text), "--settings")
    values: dict[str, object] = {}
    for name in text.split(","):
        config.merge(values, config.read_yaml(Path(name)))
    return config.parse(Config, values, f"--settings {text}")


def read_row(text: str, settings: Config) -> ScenarioRow:
    """A row of the scenario table, by its name or as JSON. Raises InputError."""
    from neuspring.data.sources import read_scenarios

    if text.lstrip().startswith("{"):
        return config.parse(ScenarioRow, json_value("--scenario", text), "--scenario")
    rows = read_scenarios(Path(settings.scenario_table))
    if text not in rows:
        raise InputError("--scenario", f"must be a row of {settings.scenario_table}, or JSON", text)
    return rows[text]


def json_value(option: str, text: str, kind: type = dict) -> Any:
    """The JSON object (or list) given with an option. Raises InputError."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(option, "must be JSON", str(error)) from error
    if not isinstance(values, kind):
        raise InputError(option, f"must be a JSON {'object' if kind is dict else 'list'}", type(values).__name__)
    return values
