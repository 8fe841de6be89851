"""A stage of the workflow: one typed function with declarations.

The signature and the decorator `stage` define everything else: the command with its options, the rule, the input digests and
settings in the record, and how failures are passed on.

| type of a parameter | meaning |
|---|---|
| `Observations`, `Capture` | a file of an earlier stage, passed to the function as a loaded object |
| `Before` | the record of an earlier stage; if that stage failed, this one fails with the same reason, except for `MayFail` |
| a sequence of these | the files of all cameras, or of several recordings |
| any other type | an option of the command, stored in the record |

| name of a parameter | meaning |
|---|---|
| `settings` | the `Config`; the keys in `reads` are passed to the rule and stored in the record |
| `run` | the `Recorder` of the stage's record; a stage without it writes its product to its parameter `output` |
| `device`, `threads`, `twins_per_launch` | where and how the stage runs; they change no result and are not stored |

An input has the name of its file: `masks` is the masks.json of stage `segment`, `search` a search.json. A sequence of
observations has the name of the field of `Rows` that lists the recordings: `pool` or `targets`.

The workflow evaluates a stage's declarations with the `Rows` of a job: whether the job exists, which inputs it omits, the values
of its options, and the rule that runs it.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from neuspring import config
from neuspring.config import Config, Method, ScenarioRow, SearchRow
from neuspring.config.parse import json_value
from neuspring.config.settings import read_settings, select
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.provenance import code_digest, image_stamps
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import CAPTURE, Capture

if TYPE_CHECKING:
    from neuspring.scenes.sources import Source

PLACES = ("device", "threads", "twins_per_launch")
"""Parameters that define where and how a stage runs."""
LOADERS: dict[Any, Callable[[Path], Any]] = {
    Observations: Observations.load,
    Capture: lambda path: Capture.load(path.parent),
    Before: Before.load,
}
"""Type of an input -> reader of its file."""
MAY_FAIL = "may have failed"
MayFail = Annotated[Before, MAY_FAIL]
"""The record of a stage that may have failed."""
SETTINGS_HELP = "JSON, or YAML files separated by commas; without it, the defaults"


@dataclass(frozen=True, kw_only=True)
class Written:
    """The results of a stage, for its record."""

    files: Mapping[str, Path] = field(default_factory=dict)
    """Role -> file in the record's folder."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Results as numbers and text."""
    failure: str = ""
    """Why the stage failed, if it failed with files."""
    attempts: int = 1
    earlier_seconds: float = 0.0
    """Duration of the attempts from whose checkpoints it resumed, s."""
    checkpoint: Path | None = None
    """Checkpoint to delete after the record is written."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a stage: an input file, an option, or one of `PLACES`."""

    type: Any
    """Type of the value, or of the entries of a sequence, without `None`."""
    many: bool
    """True for a sequence."""
    default: Any
    note: str
    """The annotation of the type, which is the help text of the command."""

    @property
    def is_input(self) -> bool:
        """True for an input file."""
        return self.type in LOADERS

    @property
    def required(self) -> bool:
        """True without a default."""
        return self.default is inspect.Parameter.empty


_stamps = functools.cache(image_stamps)


@dataclass(frozen=True, kw_only=True)
class Rows:
    """The table rows of a job, with which the declarations of its stage are evaluated."""

    config: Config
    """The configuration, overridden by the settings of the method and of the search."""
    scenario: ScenarioRow
    source: Source
    data: Path | None
    """Folder or file of the scenario's data; None for simulated scenes."""
    images: bool
    """True if predictions are rendered and scored."""
    method: Method | None = None
    """The method of the wildcard `method` or `looks`; None for a job that all methods share."""
    search: SearchRow | None = None
    """The search of the wildcard `search`, or of the method; None for models of baselines."""
    pool: tuple[str, ...] = ()
    """The other recordings of the pool, for methods with a pool."""
    targets: tuple[str, ...] = ()
    """Recordings to which the scenario's models are transferred."""

    @property
    def image_stamps(self) -> str:
        """A digest that changes with the user's images; empty for simulated images and without images."""
        return _stamps(self.data) if self.data and (self.source.films or self.source.capture_files) else ""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One call of a stage: its inputs, options and settings, and the `Recorder` that measures it."""

    stage: Stage
    output: Path
    settings: Config
    values: Mapping[str, Any]
    """Options and places by name."""
    files: Mapping[str, Sequence[Path]]
    """Inputs by parameter."""
    record: Recorder

    @property
    def finished(self) -> bool:
        """True if the result exists and was made from the same inputs, settings and code."""
        return self.output.exists() and self.record.agrees()

    @functools.cached_property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the function, with loaded inputs. Raises InputError for damaged files."""
        values = dict(self.values)
        for name, parameter in self.stage.inputs.items():
            loaded = [LOADERS[parameter.type](path) for path in self.files[name]]
            values[name] = loaded if parameter.many else loaded[0] if loaded else None
        special = {"settings": self.settings, "run": self.record, "output": self.output}
        return values | {name: value for name, value in special.items() if name in self.stage.signature}

    @property
    def failed(self) -> Before | None:
        """The first required input that failed, whose failure is passed on."""
        required = [n for n, p in self.stage.inputs.items() if p.type is Before and p.note != MAY_FAIL]
        inputs = [Before.load(path) for name in required for path in self.files[name]]
        return next((before for before in inputs if before.record.status == "failed"), None)

    def run(self) -> None:
        """Run the function and write the record, also for a numerical failure of this or an earlier stage."""
        reset_opencv()
        if "run" not in self.stage.signature:
            self.stage.function(**self.arguments)
            self.record.save()
        elif failed := self.failed:
            earlier = failed.record
            self.record.save(failure=f"{earlier.stage}: {earlier.reason.removeprefix(f'{earlier.stage}: ')}")
        else:
            try:
                self.keep(self.stage.function(**self.arguments))
            except NumericalFailure as failure:
                self.record.save(failure=str(failure))

    def keep(self, made: Written) -> None:
        """Write the record of these results and delete the checkpoint."""
        self.record.save(made.files, made.facts, failure=made.failure, attempts=made.attempts, earlier_seconds=made.earlier_seconds)
        if made.checkpoint:
            made.checkpoint.unlink(missing_ok=True)


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage, called with the paths of its inputs, its options and `output`."""

    function: Callable[..., Any]
    output: str
    """The file that it writes in the results folder, with the wildcards of the job."""
    reads: tuple[str, ...] | Callable[[Config, Mapping[str, Any]], Sequence[str]] = ()
    """Keys of the settings that it reads, or a function of the settings and all parameters that returns them."""
    code: Callable[[Config, Mapping[str, Any]], Sequence[str]] = lambda settings, values: ()
    """Modules that it imports by name: backends, readers, baselines."""
    gpu: bool | Callable[[Config], bool] = False
    """Whether its jobs use a GPU if there is one, or a function of the settings."""
    memory_mb: int = 4000
    minutes: int = 30
    """Requested memory and time of its jobs at the first attempt."""
    when: Callable[[Rows], bool] = lambda rows: True
    """Whether the job exists."""
    instead: Callable[[Rows], Path | None] = lambda rows: None
    """The user's file that later stages read if the job does not exist."""
    without: Callable[[Rows], Collection[str]] = lambda rows: ()
    """Inputs that the job omits."""
    given: Callable[[Rows], Mapping[str, Any]] = lambda rows: {}
    """Options whose values come from rows; the others are wildcards or have the default of the signature."""
    settled: Callable[[Rows], Config] = lambda rows: rows.config
    """The configuration, with defaults for settings that the job does not use: changing these does not repeat it."""
    also: Callable[[Rows], Iterable[Path]] = lambda rows: ()
    """Further files that the job requires, or whose change repeats it, and that its command does not name."""
    stamp: Callable[[Rows], str] = lambda rows: ""
    """Text whose change repeats the job and that is not recorded: stamps of images, available weights."""
    shared: Callable[[Config, Method], Any] | None = None
    """Key of the result, from a method and its configuration: methods with equal keys share the job of the first of them in the
    method table. A key None: the method has no such job. Without this declaration, every method has its own job."""
    rule: str = ""
    """The rule whose jobs run it, together with other stages; empty: the rule of its own name."""
    alike: Callable[[Rows], Any] | None = None
    """Jobs with equal keys can share launches in a batch; a key None: no batch."""
    least_on_cpu: int | None = None
    """Minimum size of a batch on a CPU, where a batch contains one scenario; None: no batches on a CPU."""
    many: Callable[[Sequence[Job]], Sequence[Written | Exception]] | None = None
    """Runs a batch; returns the results of each job, or its error."""

    # --- declarations

    @property
    def name(self) -> str:
        """The name of its rule and its command."""
        return self.function.__name__

    @property
    def about(self) -> str:
        """Its inputs and products, in one line."""
        return re.split(r": |\.?\n|\.$", inspect.getdoc(self.function) or "")[0]

    @functools.cached_property
    def product(self) -> str:
        """The name of the input with which later stages read its output."""
        return Path(self.output).stem

    @functools.cached_property
    def wildcards(self) -> tuple[str, ...]:
        """Names that distinguish its jobs."""
        return tuple(re.findall(r"{(\w+)}", self.output))

    @property
    def job_rule(self) -> str:
        """The rule whose jobs run it."""
        return self.rule or self.name

    @functools.cached_property
    def signature(self) -> Mapping[str, inspect.Parameter]:
        """The parameters of the function, from `inspect`."""
        return inspect.signature(self.function).parameters

    @functools.cached_property
    def parameters(self) -> dict[str, Parameter]:
        """All parameters except `settings` and `run`."""
        hints, parameters = typing.get_type_hints(self.function, include_extras=True), {}
        for name, declared in self.signature.items():
            if name in ("settings", "run"):
                continue
            hint, note = hints[name], ""
            if typing.get_origin(hint) in (typing.Union, types.UnionType):
                parts = [part for part in typing.get_args(hint) if part is not types.NoneType]
                hint = parts[0] if len(parts) == 1 else hint
            if typing.get_origin(hint) is Annotated:
                hint, note = typing.get_args(hint)[:2]
            many = typing.get_origin(hint) is Sequence
            if many:
                hint = typing.get_args(hint)[0]
            kind = dict if typing.get_origin(hint) is dict else hint
            parameters[name] = Parameter(kind, many, declared.default, note)
        return parameters

    @functools.cached_property
    def inputs(self) -> dict[str, Parameter]:
        """Parameters that are input files."""
        return {name: parameter for name, parameter in self.parameters.items() if parameter.is_input}

    @functools.cached_property
    def options(self) -> dict[str, Parameter]:
        """Parameters that are options of the command."""
        return {n: p for n, p in self.parameters.items() if not p.is_input and n not in (*PLACES, "output")}

    @functools.cached_property
    def places(self) -> tuple[str, ...]:
        """Its parameters in `PLACES`."""
        return tuple(name for name in PLACES if name in self.parameters)

    def record_of(self, output: Path) -> Path:
        """Path of the record of a job that writes `output`: that file, or one next to a product that is not a record."""
        return output if "run" in self.signature else output.with_name(f"{self.name}.record.json")

    def code_of(self, values: Config, given: Mapping[str, Any]) -> str:
        """The digest of its code for these settings and parameters."""
        return code_digest(self.function.__module__, *self.code(values, given))

    def settings(self, values: Config, given: Mapping[str, Any]) -> dict[str, Any]:
        """The settings that it reads for these values of its parameters."""
        return select(values, self.reads(values, given) if callable(self.reads) else self.reads)

    # --- execution

    def job(self, *, output: Path, settings: Config | None = None, **given: Any) -> Job:
        """Digest the inputs and start the record. Raises InputError for missing and unknown parameters."""
        unknown = sorted(given.keys() - self.parameters.keys())
        missing = [n for n, p in self.parameters.items() if p.required and n not in given and n != "output"]
        if unknown or missing:
            raise InputError(f"stage {self.name}", f"takes {', '.join(self.parameters)}", f"missing {missing}, unknown {unknown}")
        values = {name: given.get(name, parameter.default) for name, parameter in self.parameters.items()}
        if "device" in values:
            from neuspring.core.device import resolve_device

            values["device"] = resolve_device(values["device"])
        files: dict[str, list[Path]] = {}
        roles: dict[str, Path] = {}
        for name, parameter in self.inputs.items():
            value = values[name] if parameter.many or values[name] is None else [values[name]]
            files[name] = [Path(path) for path in value or ()]
            roles |= {f"{name}{place}" if parameter.many else name: path for place, path in enumerate(files[name])}
        chosen, output = settings or Config(), Path(output)
        options = {n: config.plain(v) if dataclasses.is_dataclass(v := values[n]) else v for n in self.options}
        read, code = self.settings(chosen, values) | options, self.code_of(chosen, values)
        device = values.get("device", "cpu")
        record = Recorder(self.name, self.record_of(output), inputs=roles, settings=read, device=device, code=code)
        for path in (files[name][0].parent for name, item in self.inputs.items() if item.type is Capture and files[name]):
            # The record of stage `capture` covers the images that it made; a user's images may change.
            if not (path / "capture.record.json").exists():
                record.inputs["images"] = image_stamps(path)
        return Job(stage=self, output=output, settings=chosen, values=values, files=files, record=record)

    def __call__(self, *, output: Path, settings: Config | None = None, **given: Any) -> None:
        """Run the stage and write its record."""
        self.job(output=output, settings=settings, **given).run()

    # --- its command

    def parse(self, words: Sequence[str]) -> dict[str, Any]:
        """Parse a command line into arguments of `__call__`. Raises InputError, and SystemExit for unknown options."""
        import tyro

        fields: list[Any] = []
        for name, parameter in self.parameters.items():
            kind: Any = Path if parameter.is_input else str if parameter.type in (ScenarioRow, dict) else parameter.type
            default = parameter.default
            if parameter.many:
                kind, default = tuple[kind, ...], default if parameter.required else ()
            elif default is None:
                kind = kind | None
            declared = (name, Annotated[kind, tyro.conf.arg(help=parameter.note or _about(name, parameter))])
            fields.append(declared if parameter.required else (*declared, field(default=default)))
        if "output" not in self.parameters:
            fields.append(("output", Annotated[Path, tyro.conf.arg(help=f"{Path(self.output).name} to write")]))
        if "settings" in self.signature:
            fields.append(("settings", Annotated[str, tyro.conf.arg(help=SETTINGS_HELP)], field(default="{}")))
        made = dataclasses.make_dataclass(self.name, fields, kw_only=True)
        pairs = (tyro.conf.FlagCreatePairsOff,)
        about = f"{self.about}."
        read = dataclasses.asdict(tyro.cli(made, args=list(words), prog=f"neuspring {self.name}", description=about, config=pairs))
        if "settings" in read:
            read["settings"] = read_settings(read["settings"])
        for name, parameter in self.parameters.items():
            if parameter.type is ScenarioRow:
                read[name] = read_row(read[name], read.get("settings") or Config())
            elif parameter.type is dict and read[name] is not None:
                read[name] = json_value(f"--{name}", read[name])
            elif parameter.many:
                read[name] = list(read[name])
        return read


def stage(output: str, **declared: Any) -> Callable[[Callable[..., Any]], Stage]:
    """Decorator that makes a function a stage; the fields of `Stage` are the declarations."""
    return lambda function: Stage(function, output, **declared)


def _about(name: str, parameter: Parameter) -> str:
    """Help text of a parameter without a note."""
    if parameter.type is ScenarioRow:
        return "a row of the scenario table, by its name or as JSON"
    if parameter.type is Before:
        return f"{name}.json" + (" of every camera, in order" if parameter.many else "")
    return {Capture: "capture.json", Observations: "observations.npz"}.get(parameter.type, "")


def read_row(text: str, settings: Config) -> ScenarioRow:
    """Read a row of the scenario table, by its name or as JSON. Raises InputError."""
    from neuspring.scenes.sources import scenario_rows

    if text.lstrip().startswith("{"):
        return config.parse(ScenarioRow, json_value("--scenario", text), "--scenario")
    rows = scenario_rows(settings, also=(text,))
    if text not in rows:
        rule = f"must be a row of {settings.scenario_table}, a capture or recording in data_root, or JSON"
        raise InputError("--scenario", rule, text)
    return rows[text]


def reset_opencv() -> None:
    """Reset OpenCV's random generator to its initial state: grabCut uses it, and other stages may have run in this process."""
    if cv2 := sys.modules.get("cv2"):
        cv2.setRNGSeed(0)


def physics(rows: Rows) -> tuple[Any, ...]:
    """The physics of a scenario, which must be equal for all members of a launch."""
    return rows.scenario.self_collision, rows.scenario.ground


def paths(records: Iterable[Before]) -> list[Path]:
    """Paths of the records."""
    return [before.path for before in records]


def there(data: Path | None, names: Sequence[str]) -> list[Path]:
    """The existing files of these names in a user's folder; if `data` is a file, that file."""
    if data is None:
        return []
    return [data] if data.is_file() else [data / name for name in names if (data / name).exists()]


def require_length(capture: Capture, observations: Observations) -> None:
    """Raise InputError if a capture and its observations have different numbers of frames."""
    if capture.frame_count != observations.scenario.frame_count:
        rule = f"must have as many frames as the observations: {observations.scenario.frame_count}"
        remedy = "Correct the data, or set images.enabled: false to skip images."
        raise InputError(capture.folder / CAPTURE, rule, capture.frame_count, remedy)
