"""A stage of the workflow: one typed function.

The signature says what it reads, and from it and the decorator `stage` everything else follows: the command and its options, the
rule, the digests of the inputs and the settings in the record, the passing on of failures.

| a parameter of type | is |
|---|---|
| `Observations`, `Capture` | a file of an earlier stage, which the function gets loaded |
| `Before` | the record of an earlier stage; one that failed ends this stage with the same reason, unless it is `MayFail` |
| a sequence of these | such files of all cameras, or of several recordings |
| anything else | an option of the command, which stands in the record |

| a parameter named | is |
|---|---|
| `settings` | the `Config`: the keys of `reads` are given to the rule and stand in the record |
| `run` | the `Recorder` of the record to be; a stage without one writes its product, its parameter `output`, beside its record |
| `device`, `threads`, `twins_per_launch` | where and how it runs, which changes no result and stands in no record |

An input has the name of the file that it is: `masks` is the masks.json that stage `segment` writes, `search` a search.json. One
that is a sequence of observations has the name of a field of `Rows`, which lists the recordings: `pool`, `targets`.

The workflow asks the declarations of a stage with the `Rows` behind a job: where there are such jobs, which inputs one goes
without, what the tables tell its options, which rule's jobs run it. It knows no stage by name.
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
"""Parameters that say where and how a stage runs."""
LOADERS: dict[Any, Callable[[Path], Any]] = {
    Observations: Observations.load,
    Capture: lambda path: Capture.load(path.parent),
    Before: Before.load,
}
"""Reader of a file of each type of input."""
MAY_FAIL = "may have failed"
MayFail = Annotated[Before, MAY_FAIL]
"""A record that the function wants also of a stage that failed."""
SETTINGS_HELP = "JSON, or YAML files separated by commas; defaults otherwise"


@dataclass(frozen=True, kw_only=True)
class Written:
    """The results of a stage, for its record."""

    files: Mapping[str, Path] = field(default_factory=dict)
    """Role -> file beside the record."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Numbers and text worth keeping."""
    failure: str = ""
    """Why the stage failed, where it left files nevertheless."""
    attempts: int = 1
    earlier_seconds: float = 0.0
    """Seconds of the attempts that it continued."""
    checkpoint: Path | None = None
    """No longer needed once the record is there."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a stage: an input file, an option, or where it runs."""

    type: Any
    """Type of its value, or of the entries of a sequence; without what says that it may be left out."""
    many: bool
    """True for a sequence."""
    default: Any
    note: str
    """The text beside the type, for the help of the command."""

    @property
    def is_input(self) -> bool:
        """True for names of files."""
        return self.type in LOADERS

    @property
    def required(self) -> bool:
        """True where it must be given."""
        return self.default is inspect.Parameter.empty


_stamps = functools.cache(image_stamps)


@dataclass(frozen=True, kw_only=True)
class Rows:
    """The rows of a benchmark's tables behind a job: what declarations of its stage are asked with."""

    config: Config
    """With the settings of the method and of the search on top."""
    scenario: ScenarioRow
    source: Source
    data: Path | None
    """Folder or file of the scenario's data; None for scenes that are made here."""
    images: bool
    """True where predictions are drawn and scored."""
    method: Method | None = None
    """The row of the wildcard `method`, or of `looks`; None where a job belongs to no method."""
    search: SearchRow | None = None
    """The row of the wildcard `search`, or of the method; None for models of baselines."""
    pool: tuple[str, ...] = ()
    """The other recordings of the pool, of a method that has one."""
    targets: tuple[str, ...] = ()
    """Recordings to which the scenario's models are transferred."""

    @property
    def image_stamps(self) -> str:
        """A digest that tells changed images of the user's apart; empty where images are made here, or there are none."""
        return _stamps(self.data) if self.data and (self.source.films or self.source.capture_files) else ""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A stage with everything that it was given; its record is begun."""

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
        """True where the result is there, made of the same inputs, settings and code."""
        return self.output.exists() and self.record.agrees()

    @functools.cached_property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the function, with the inputs loaded. Raises InputError for what is damaged."""
        values = dict(self.values)
        for name, parameter in self.stage.inputs.items():
            loaded = [LOADERS[parameter.type](path) for path in self.files[name]]
            values[name] = loaded if parameter.many else loaded[0] if loaded else None
        own = {"settings": self.settings, "run": self.record, "output": self.output}
        return values | {name: value for name, value in own.items() if name in self.stage.signature}

    @property
    def failed(self) -> Before | None:
        """The first input whose failure is passed on."""
        required = [n for n, p in self.stage.inputs.items() if p.type is Before and p.note != MAY_FAIL]
        before = [Before.load(path) for name in required for path in self.files[name]]
        return next((one for one in before if one.record.status == "failed"), None)

    def run(self) -> None:
        """Run the function, and write the record. A numerical failure is recorded, its own or that of an earlier stage."""
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
        """Write the record of these results."""
        self.record.save(made.files, made.facts, failure=made.failure, attempts=made.attempts, earlier_seconds=made.earlier_seconds)
        if made.checkpoint:
            made.checkpoint.unlink(missing_ok=True)


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage, called with the paths of its inputs, its options and `output`."""

    function: Callable[..., Any]
    output: str
    """The file that it writes below the results folder, with the job's wildcards."""
    reads: tuple[str, ...] | Callable[[Config, Mapping[str, Any]], Sequence[str]] = ()
    """Keys of the settings that it reads; or from the settings and the values of all parameters to these keys."""
    code: Callable[[Config, Mapping[str, Any]], Sequence[str]] = lambda settings, values: ()
    """Modules that it imports by name: backends, readers, baselines."""
    gpu: bool | Callable[[Config], bool] = False
    """True where its jobs take a GPU if there is one; or from the settings."""
    memory_mb: int = 4000
    minutes: int = 30
    """Memory and time that its first jobs ask for, before any was measured."""
    when: Callable[[Rows], bool] = lambda rows: True
    """True where there is such a job."""
    instead: Callable[[Rows], Path | None] = lambda rows: None
    """The user's file that later stages take where there is no such job."""
    without: Callable[[Rows], Collection[str]] = lambda rows: ()
    """Inputs that a job goes without."""
    given: Callable[[Rows], Mapping[str, Any]] = lambda rows: {}
    """Options whose values stand in rows; others are wildcards, or have the default of the signature."""
    settled: Callable[[Rows], Config] = lambda rows: rows.config
    """The configuration with defaults for what such a job does not read, so that a change of it runs nothing again."""
    also: Callable[[Rows], Iterable[Path]] = lambda rows: ()
    """Files without which a job cannot run, or whose change runs it again, and which its command does not name."""
    stamp: Callable[[Rows], str] = lambda rows: ""
    """Text that makes a job run again and stands in no record: images that a capture is made of, weights that are there."""
    shared: Callable[[Config, Method], Any] | None = None
    """From a method and its configuration, what its result depends on: methods with the same share the job of the first one in the
    table. None: it has no such job, or, without this declaration, each method has its own."""
    rule: str = ""
    """The rule whose jobs run it, with other stages; empty: one of its own name."""
    alike: Callable[[Rows], Any] | None = None
    """Jobs of equal key can share launches in a batch; None: no others can."""
    least_on_cpu: int | None = None
    """Members of a batch on a CPU, at least, which are of one scenario; None: there are no batches on a CPU."""
    many: Callable[[Sequence[Job]], Sequence[Written | Exception]] | None = None
    """Runs a batch: what each job made, or the error that ended it."""

    # --- what it declares

    @property
    def name(self) -> str:
        """The name of its rule and its command."""
        return self.function.__name__

    @property
    def about(self) -> str:
        """Its products and inputs, in a line."""
        return re.split(r": |\.?\n|\.$", inspect.getdoc(self.function) or "")[0]

    @functools.cached_property
    def product(self) -> str:
        """The name under which later stages take what it writes."""
        return Path(self.output).stem

    @functools.cached_property
    def wildcards(self) -> tuple[str, ...]:
        """Names that tell its jobs apart."""
        return tuple(re.findall(r"{(\w+)}", self.output))

    @property
    def job_rule(self) -> str:
        """The rule whose jobs run it."""
        return self.rule or self.name

    @functools.cached_property
    def signature(self) -> Mapping[str, inspect.Parameter]:
        """The parameters of the function, as Python has them."""
        return inspect.signature(self.function).parameters

    @functools.cached_property
    def parameters(self) -> dict[str, Parameter]:
        """All parameters but the settings and the record."""
        hints, found = typing.get_type_hints(self.function, include_extras=True), {}
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
            found[name] = Parameter(kind, many, declared.default, note)
        return found

    @functools.cached_property
    def inputs(self) -> dict[str, Parameter]:
        """The files that it reads."""
        return {name: parameter for name, parameter in self.parameters.items() if parameter.is_input}

    @functools.cached_property
    def options(self) -> dict[str, Parameter]:
        """Parameters beside files and settings."""
        return {n: p for n, p in self.parameters.items() if not p.is_input and n not in (*PLACES, "output")}

    @functools.cached_property
    def places(self) -> tuple[str, ...]:
        """Those of `PLACES` that it takes."""
        return tuple(name for name in PLACES if name in self.parameters)

    def record_of(self, output: Path) -> Path:
        """Place of the record of a job that writes `output`: there, or beside a product that is no record."""
        return output if "run" in self.signature else output.with_name(f"{self.name}.record.json")

    def code_of(self, values: Config, given: Mapping[str, Any]) -> str:
        """The digest of the code that makes it, given these values of its parameters."""
        return code_digest(self.function.__module__, *self.code(values, given))

    def settings(self, values: Config, given: Mapping[str, Any]) -> dict[str, Any]:
        """The part of the settings that the stage reads, given these values of its parameters."""
        return select(values, self.reads(values, given) if callable(self.reads) else self.reads)

    # --- how it runs

    def job(self, *, output: Path, settings: Config | None = None, **given: Any) -> Job:
        """Digest the inputs and begin the record. Raises InputError for what is missing or unknown."""
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
        for path in (files[name][0].parent for name, one in self.inputs.items() if one.type is Capture and files[name]):
            # Of images that stage `capture` made, its record says all; a user's may change.
            if not (path / "capture.record.json").exists():
                record.inputs["images"] = image_stamps(path)
        return Job(stage=self, output=output, settings=chosen, values=values, files=files, record=record)

    def __call__(self, *, output: Path, settings: Config | None = None, **given: Any) -> None:
        """Run it, and write its record."""
        self.job(output=output, settings=settings, **given).run()

    # --- its command

    def parse(self, words: Sequence[str]) -> dict[str, Any]:
        """Values of a command line, as `__call__` takes them. Raises InputError, and SystemExit for words that are no options."""
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
    """The decorator of a stage; see `Stage` for what is declared."""
    return lambda function: Stage(function, output, **declared)


def _about(name: str, parameter: Parameter) -> str:
    """Help of a command on a parameter without a note."""
    if parameter.type is ScenarioRow:
        return "a row of the scenario table, by its name or as JSON"
    if parameter.type is Before:
        return f"{name}.json" + (" of every camera, in their order" if parameter.many else "")
    return {Capture: "capture.json", Observations: "observations.npz"}.get(parameter.type, "")


def read_row(text: str, settings: Config) -> ScenarioRow:
    """A row of the scenario table, by its name or as JSON. Raises InputError."""
    from neuspring.scenes.sources import scenario_rows

    if text.lstrip().startswith("{"):
        return config.parse(ScenarioRow, json_value("--scenario", text), "--scenario")
    rows = scenario_rows(settings, also=(text,))
    if text not in rows:
        rule = f"must be a row of {settings.scenario_table}, a capture or recording in data_root, or JSON"
        raise InputError("--scenario", rule, text)
    return rows[text]


def reset_opencv() -> None:
    """Set OpenCV's random generator as in a new process: grabCut draws from it, and other stages may have run before this one."""
    if cv2 := sys.modules.get("cv2"):
        cv2.setRNGSeed(0)


def physics(rows: Rows) -> tuple[Any, ...]:
    """The physics, of which a launch has one, as the scenario table says it."""
    return rows.scenario.self_collision, rows.scenario.ground


def paths(records: Iterable[Before]) -> list[Path]:
    """Files of the records."""
    return [before.path for before in records]


def there(data: Path | None, names: Sequence[str]) -> list[Path]:
    """The files of these names in a folder of the user's that are there; data that are one file are that file."""
    if data is None:
        return []
    return [data] if data.is_file() else [data / name for name in names if (data / name).exists()]


def require_length(capture: Capture, observations: Observations) -> None:
    """Raise InputError unless a capture and its observations have as many frames."""
    if capture.frame_count != observations.scenario.frame_count:
        rule = f"must have as many frames as the observations: {observations.scenario.frame_count}"
        remedy = "Correct the data, or set images.enabled: false to go without pictures."
        raise InputError(capture.folder / CAPTURE, rule, capture.frame_count, remedy)
