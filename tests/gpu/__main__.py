"""All checks and measurements of a machine with a GPU: `python -m tests.gpu [--device cuda:0] [--again] [--parts tests,fit]`.

Parts: the simulator, the rasterizer, skinning, Spring-Gaus, a small search and a small fit against the CPU; the tests marked
`cuda`; the benchmark; gsplat against our rasterizer where it is installed. Everything lands in results/gpu; gpu.json there holds it
all. `--device cpu` compares the CPU with itself, in results/gpu/cpu: it tests this command where there is no GPU.

Exit status: 0 where all is well, 1 where a part failed, 2 where there is no GPU.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.core import provenance
from neuspring.core.device import resolve_device, start_warp
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from tests.gpu.chain import FAILED, ROOT, Part, digest, report, run
from tests.gpu.parts import NAMES, parts

RESULTS = ROOT / "results/gpu"
SECONDS = 480.0
"""For all parts together."""


def main(arguments: list[str] | None = None) -> int:
    """Run the parts; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0", choices=("cuda:0", "cpu"), help="CUDA_VISIBLE_DEVICES chooses among GPUs")
    parser.add_argument("--again", action="store_true", help="run parts that are done anew")
    parser.add_argument("--parts", default=",".join(NAMES), help=f"of {','.join(NAMES)}")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for all parts together; the next call goes on")
    parser.add_argument("--results", type=Path, help="default: results/gpu, or results/gpu/cpu")
    options = parser.parse_args(arguments)
    wanted = options.parts.split(",")
    if not set(wanted) <= set(NAMES):
        parser.error(f"--parts takes of {','.join(NAMES)}; received {options.parts}")
    try:
        machine = describe(options.device)
    except InputError as error:
        print(f"{error}\nThis command needs a GPU, its driver and a CUDA build of torch. `--device cpu` tests it without.")
        return 2
    start, folder = time.monotonic(), (options.results or RESULTS / ("cpu" if options.device == "cpu" else "")).resolve()
    print(", ".join(f"{name} {value}" for name, value in machine.items()), flush=True)
    chosen: list[Part] = [part for part in parts(options.device, folder) if part.name in wanted]
    records = run(chosen, folder, {"code": digest(), **machine}, options.seconds, again=options.again)
    failed = [record["part"] for record in records if record["outcome"] == FAILED]
    whole = {"commit": provenance.commit(), "machine": machine, "seconds": round(time.monotonic() - start, 1), "failed": failed}
    write_text(folder / "gpu.json", json.dumps(whole | {"parts": records}, indent=1) + "\n")
    print(report(records))
    print(f"\n{len(records) - len(failed)} of {len(records)} parts without a failure, {whole['seconds']} s, {folder / 'gpu.json'}")
    return 1 if failed else 0


def describe(device: str) -> dict[str, Any]:
    """What computes, in words. Raises InputError if torch or Warp finds no such device."""
    resolve_device(device)
    start_warp()
    versions = {"torch": torch.__version__, "warp": wp.__version__, "numpy": np.__version__, "python": platform.python_version()}
    if device == "cpu":
        return {"device": device, "name": platform.machine()} | versions
    if not wp.get_cuda_devices():
        built = f"Warp {wp.__version__}, built for CUDA {'.'.join(map(str, wp.get_cuda_toolkit_version()))}"
        raise InputError("device", "Warp must find the GPU too", "none", f"Update the driver to one that serves {built}.")
    facts = torch.cuda.get_device_properties(0)
    return {
        "device": device,
        "name": facts.name,
        "sm": f"{facts.major}{facts.minor}",
        "multiprocessors": facts.multi_processor_count,
        "GiB": round(facts.total_memory / 2**30),
        "CUDA of the driver": ".".join(map(str, wp.get_cuda_driver_version())),
        "CUDA of torch": torch.version.cuda,
        **versions,
    }


if __name__ == "__main__":
    sys.exit(main())
