"""Settings of the GPUs of one machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from neuspring.config.types import Count, Section

Device = Annotated[int, Field(ge=0)] | Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9/._-]*$")]


@dataclass(frozen=True, kw_only=True)
class Gpus(Section):
    """GPUs of this machine that jobs lease. On a cluster these are not read: its scheduler chooses."""

    devices: Literal["all"] | tuple[Device, ...] = "all"
    """Indices or UUIDs of the GPUs; all: those of CUDA_VISIBLE_DEVICES, or all of the machine where it is not set."""
    jobs_per_gpu: Count = 1
    """Number of jobs that share a GPU; use 1 for timings that can be compared."""

    def __post_init__(self) -> None:
        if self.devices != "all" and (not self.devices or len(set(map(str, self.devices))) != len(self.devices)):
            raise ValueError(f"devices: at least one, each once, is required, received {list(self.devices)}")
