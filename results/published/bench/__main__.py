"""Measure the times of the simulator:

    python -m results.published.bench [--quick] [--only SECTION] [--device DEVICE] [--peer CHECKOUT] [--save]

Measures on one CPU thread, then on the first GPU if there is one; --device selects one of them. Prints a table, with the change of
every row against the committed table of the same kind of machine. Writes results/bench/<kind of machine>.json, or with --save
results/published/bench/<kind of machine>.json, which you commit. Takes about five minutes on a CPU, at most two on a GPU.
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
    """Measure, print and write the table."""
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
    print(f"compared with commit {kept['machine']['commit']}" if kept else f"no committed table of {kind}")
    print(table.save(table.as_record(facts, rows, notes), kind, committed=options.save).relative_to(table.ROOT))


def devices(chosen: str | None) -> list[str]:
    """Devices to measure on: `chosen`, or the CPU and the first GPU, if there is one."""
    return [resolve_device(chosen)] if chosen else ["cpu", *(["cuda:0"] if torch.cuda.is_available() else [])]


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rows and rounds; excludes --save")
    parser.add_argument("--only", action="append", choices=list(SECTIONS), metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--device", metavar="DEVICE", help="only cpu or cuda:0 (default: both, with a GPU)")
    parser.add_argument("--peer", type=Path, metavar="CHECKOUT", help="checkout of PhysTwin; also measure its simulator")
    parser.add_argument("--save", action="store_true", help=f"write into {table.COMMITTED}")
    options = parser.parse_args(arguments)
    if options.save and (options.quick or options.only or options.device):
        parser.error("--save: requires a complete table. Remove --quick, --only and --device.")
    return options


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
