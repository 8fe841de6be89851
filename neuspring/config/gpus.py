"""Settings of the GPUs of one machine; part of `neuspring.config.settings`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from neuspring.config.types import STRICT, Count

Device = Annotated[int, Field(ge=0)] | Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9/._-]*$")]


@dataclass(frozen=True, kw_only=True)
class Gpus:
    """GPUs of this machine that jobs share, one lease at a time. On a cluster its scheduler chooses; these are not read there."""

    __pydantic_config__ = STRICT
    devices: Literal["all"] | tuple[Device, ...] = "all"
    """Indices or UUIDs; all: those of CUDA_VISIBLE_DEVICES, else all of the machine."""
    jobs_per_gpu: Count = 1
    """Jobs that share a GPU; 1 for timings that can be compared."""

    def __post_init__(self) -> None:
        if self.devices != "all" and (not self.devices or len(set(map(str, self.devices))) != len(self.devices)):
            raise ValueError(f"devices: at least one, each once, is required, received {list(self.devices)}")
