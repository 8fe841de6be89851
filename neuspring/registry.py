"""Registries of metrics, baselines, stages and other kinds: members of this package and of installed packages.

Each kind is a `Registry` in the module that uses it (`METRICS`, `BASELINES`, `STAGES`, ...). A package adds a member by an entry
point of the group `neuspring.<kind>` in its pyproject.toml:

    [project.entry-points."neuspring.metrics"]
    my_error = "my_package.errors:MY_ERROR"

A member is an object, or a text "module:name" that is imported on first use, so listing names imports nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from pkgutil import iter_modules, resolve_name
from typing import Any, Generic, TypeVar

from neuspring.core.errors import InputError

T = TypeVar("T")
OURS = "neuspring"


class Registry(Mapping[str, T], Generic[T]):
    """Members of one kind, name -> member; those of this package come first, in the order of their declaration.

    Raises InputError if two packages register the same name, or if a member cannot be imported or has another type. An unknown
    name raises `Unknown`, which is also a KeyError.
    """

    def __init__(self, kind: str, own: Mapping[str, T | str], type: type | tuple[type, ...] | str = object) -> None:
        self.kind, self._own, self._type = kind, dict(own), type
        self._loaded: dict[str, T] = {}

    @functools.cached_property
    def _foreign(self) -> dict[str, EntryPoint]:
        points: dict[str, EntryPoint] = {}
        for point in entry_points(group=f"{OURS}.{self.kind}"):
            if _left_out(point):
                continue
            if point.name in self._own or ((other := points.get(point.name)) and other.value != point.value):
                rule = f"only one package may register the {self.kind} member {point.name}"
                raise InputError(f"package {_package(point)}", rule, point.value, "Uninstall one of the packages.")
            points[point.name] = point
        return dict(sorted(points.items()))

    @functools.cached_property
    def left_out(self) -> set[str]:
        """Names that belong to removed extensions of this package."""
        return {point.name for point in entry_points(group=f"{OURS}.{self.kind}") if _left_out(point)}

    def __getitem__(self, name: str) -> T:
        if name not in self._loaded:
            if name in self._own:
                member = _resolved(self._own[name])
            elif name in self._foreign:
                member = self._imported(self._foreign[name])
            else:
                raise Unknown(self.kind, name, list(self))
            self._loaded[name] = member
        return self._loaded[name]

    def _imported(self, point: EntryPoint) -> Any:
        where, remedy = f"package {_package(point)}, {self.kind} {point.name}", "Fix or uninstall the package."
        try:
            member = point.load()
        except Exception as error:
            raise InputError(where, "must be importable", f"{type(error).__name__}: {error}", remedy) from error
        kind = _resolved(self._type)
        if not isinstance(member, kind):
            raise InputError(where, f"must be a {getattr(kind, '__name__', kind)}", type(member).__name__, remedy)
        return member

    def __iter__(self) -> Iterator[str]:
        return iter([*self._own, *self._foreign])

    def __len__(self) -> int:
        return len(self._own) + len(self._foreign)

    def __contains__(self, name: object) -> bool:
        return name in self._own or name in self._foreign

    def module_of(self, name: str) -> str:
        """The module in which a member is declared, for digests of code; empty for a member that is an object."""
        own = self._own.get(name) or getattr(self._foreign.get(name), "value", "")
        return own.partition(":")[0] if isinstance(own, str) else ""


class Unknown(InputError, KeyError):
    """No member has this name."""

    def __init__(self, kind: str, name: str, known: list[str]) -> None:
        super().__init__(kind, "must be a registered name", name, f"Known: {', '.join(known)}.")


def modules(package: str, member: str = "{}") -> dict[str, str]:
    """Each module of a package -> "module:name" of the member that it declares; {} in `member` stands for the module's name."""
    names = sorted(module.name for module in iter_modules(import_module(package).__path__) if not module.name.startswith("_"))
    return {name: f"{package}.{name}:{member.format(name)}" for name in names}


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else "unknown"


def _resolved(value: Any) -> Any:
    """The object that a text "module:name" names, or the value itself."""
    return resolve_name(value) if isinstance(value, str) else value


def _left_out(point: EntryPoint) -> bool:
    """True for an extension of this package whose folder the user has removed to disable it."""
    module = point.value.partition(":")[0]
    # `find_spec` would import the package.
    return module.startswith(f"{OURS}.") and not (Path(__file__).parents[1] / f"{module.replace('.', '/')}.py").exists()
