"""The table of times of the simulator:

    python -m results.published.bench [--quick] [--only SECTION] [--device DEVICE] [--peer CHECKOUT] [--save]

On the CPU, one thread, and on the first GPU where there is one; --device chooses one of them. Prints one table, and how every row
changed since the table of the same kind of machine that was kept last. Writes results/bench/<kind of machine>.json, or with
--save results/published/bench/<kind of machine>.json, which is to be committed. Some five minutes on a CPU; on a GPU at most two.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch

from neuspring.core.device import resolve_device, start_warp
from neuspring.core.errors import InputError
from results.published.bench import table
from results.published.bench.ours import Ours
from results.published.bench.phystwin import PhysTwin
from results.published.bench.rows import Bench
from results.published.bench.sections import ON_CUDA, SECTIONS


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, write."""
    options = parsed(arguments)
    torch.set_num_threads(1)
    start_warp()
    facts = table.facts()
    kind = table.kind(facts)
    rows: list[table.Row] = []
    notes: list[str] = []
    for device in devices(options.device):
        peer = PhysTwin(options.peer, device) if options.peer else None
        bench = Bench(device, Ours(device), peer, options.quick, notes)
        for section in options.only or (SECTIONS if device == "cpu" else ON_CUDA):
            begin = time.perf_counter()
            rows += SECTIONS[section](bench)
            print(f"{section}, {device}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
    kept = table.last_kept(kind)
    print(", ".join(f"{name} {value}" for name, value in facts.items() if value))
    print("", table.text(rows, kept), "", table.LEGEND, *dict.fromkeys(notes), sep="\n")
    print(f"compared with commit {kept['machine']['commit']}" if kept else f"no table of {kind} is kept")
    print(table.save(table.as_record(facts, rows, notes), kind, committed=options.save).relative_to(table.ROOT))


def devices(chosen: str | None) -> list[str]:
    """What to measure on: the device that was chosen, or the CPU and the first GPU where there is one."""
    return [resolve_device(chosen)] if chosen else ["cpu", *(["cuda:0"] if torch.cuda.is_available() else [])]


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rows and rounds; not to be saved")
    parser.add_argument("--only", action="append", choices=list(SECTIONS), metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--device", metavar="DEVICE", help="cpu or cuda:0 alone; default: both where there is a GPU")
    parser.add_argument("--peer", type=Path, metavar="CHECKOUT", help="a checkout of PhysTwin, whose simulator is then timed too")
    parser.add_argument("--save", action="store_true", help=f"write into {table.COMMITTED}")
    options = parser.parse_args(arguments)
    if options.save and (options.quick or options.only or options.device):
        parser.error("--save keeps a whole table: without --quick, --only and --device")
    return options


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
