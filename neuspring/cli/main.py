"""The `neuspring` command: every workflow step by hand, and the tools around it.

Exit status: 0 done (a numerical failure is a recorded result), 2 bad input (only another input can help), 1 anything else.
Heavy imports happen inside the commands, after the number of threads is set.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring import __version__
from neuspring.cli import tools as cli_tools
from neuspring.cli.options import Adder, add_left_out, json_mapping, read_left_out, read_settings
from neuspring.core.errors import InputError, NumericalFailure

if TYPE_CHECKING:
    from neuspring.config import Config, ScenarioRow


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    parsed = _parser().parse_args(arguments)
    threads = str(getattr(parsed, "threads", 1))
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, threads)
    try:
        status: int = parsed.run(parsed)
    except (InputError, NumericalFailure) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 1
    return status


def _row(a: argparse.Namespace, settings: Config) -> ScenarioRow:
    from neuspring import config
    from neuspring.experiments import benchmark

    if a.row:
        return config.parse(config.ScenarioRow, json_mapping("--row", a.row), "--row")
    rows = benchmark.read_scenarios(Path(settings.scenario_table))
    if a.scenario not in rows:
        raise InputError("--scenario", f"must be a row of {settings.scenario_table}", a.scenario)
    return rows[a.scenario]


def _capture(a: argparse.Namespace) -> int:
    from neuspring.stages import perceive

    chosen = read_settings(a.settings)
    perceive.make_capture(_row(a, chosen), chosen, a.output)
    return 0


def _segment(a: argparse.Namespace) -> int:
    from neuspring.stages import perceive

    perceive.segment(a.capture.parent, a.camera, read_settings(a.settings), a.device, a.output)
    return 0


def _track(a: argparse.Namespace) -> int:
    from neuspring.stages import perceive

    perceive.track(a.capture.parent, a.camera, a.masks, read_settings(a.settings), a.device, a.output)
    return 0


def _lift(a: argparse.Namespace) -> int:
    from neuspring.stages import perceive

    perceive.lift(a.capture.parent, a.masks, a.tracks, read_settings(a.settings), a.output)
    return 0


def _judge(a: argparse.Namespace) -> int:
    from neuspring.stages import perceive

    perceive.judge(a.capture.parent, a.masks, a.tracks, a.lifted, read_settings(a.settings), a.output)
    return 0


def _perception_table(a: argparse.Namespace) -> int:
    from neuspring.report.tables import perception as tables_perception

    scenarios = [(name, str(category)) for name, category in json_mapping("--scenarios", a.scenarios).items()]
    print(tables_perception.write(tables_perception.collect(a.results, scenarios), a.output.parent))
    return 0


def _observe(a: argparse.Namespace) -> int:
    from neuspring.stages import stages

    chosen = read_settings(a.settings)
    stages.observe(_row(a, chosen), chosen, a.output, a.capture and a.capture.parent, a.lifted)
    return 0


def _appearance(a: argparse.Namespace) -> int:
    from neuspring.stages import appearance

    of = {"lifted_record": a.lifted, "observations_path": a.observations}
    appearance.learn(a.capture.parent, a.masks, read_settings(a.settings), a.seed, a.device, a.output, **of)
    return 0


def _render(a: argparse.Namespace) -> int:
    from neuspring.stages import appearance

    records = (a.appearance, a.rollout)
    appearance.render(a.capture.parent, a.masks, a.observations, *records, read_settings(a.settings), a.device, a.output)
    return 0


def _draw(a: argparse.Namespace) -> int:
    from neuspring.stages import appearance

    which = (a.appearance, a.rollout, a.camera, a.frames, a.background)
    made = appearance.draw(a.capture.parent, *which, read_settings(a.settings), a.device, a.output)
    print(f"{len(made)} pictures: {a.output}")
    return 0


def _search(a: argparse.Namespace) -> int:
    from neuspring.stages import stages

    stages.search(a.observations, read_settings(a.settings), a.clusters, a.seed, a.device, a.output)
    return 0


def _fit(a: argparse.Namespace) -> int:
    from neuspring.stages import stages

    stages.fit(a.observations, a.search, read_settings(a.settings), a.kind, a.device, a.output)
    return 0


def _rollout(a: argparse.Namespace) -> int:
    from neuspring.stages import stages

    stages.rollout(a.observations, a.twin, a.carry_over, a.device, a.output)
    return 0


def _train(a: argparse.Namespace) -> int:
    from neuspring.stages import baselines as stages_baselines

    pictures = None
    if a.capture:
        if not (a.masks and a.appearance):
            raise InputError("--capture", "silhouettes need --masks and --appearance too", a.capture)
        pictures = stages_baselines.Pictures(a.capture.parent, a.masks, a.appearance)
    stages_baselines.train(a.observations, a.model, read_settings(a.settings), a.seed, a.device, a.output, pictures)
    return 0


def _predict(a: argparse.Namespace) -> int:
    from neuspring.stages import baselines as stages_baselines

    stages_baselines.predict(a.observations, a.model, a.train, a.appearance, a.device, a.output)
    return 0


def _transfer(a: argparse.Namespace) -> int:
    from neuspring.stages import stages

    stages.transfer(a.targets, a.twin, a.method, a.seed, read_settings(a.settings), a.device, a.output)
    return 0


def _score(a: argparse.Namespace) -> int:
    from neuspring.stages import stages

    given = {name: getattr(a, name) for name in ("search", "fit", "train", "rollout", "appearance", "render")}
    records = {name: path for name, path in given.items() if path}
    stages.score(a.observations, records, a.method, json_mapping("--variant", a.variant), a.seed, a.output)
    return 0


def _tables(a: argparse.Namespace) -> int:
    from neuspring.report import gallery
    from neuspring.report.tables import summary as tables
    from neuspring.scores.runs import collect, collect_transfers

    collected = collect(a.results, a.scenarios, a.methods, a.seeds, read_left_out(a.left_out))
    transfers = collect_transfers(a.results, a.transfers, a.methods, a.seeds)
    print(tables.write(collected, a.baseline or a.methods[0], a.output, transfers))
    print(f"Tables: {a.output / 'summary.md'}")
    finished = collected.runs.loc[collected.runs["status"] == "ok", "seed"].to_list()
    seed = next((seed for seed in a.seeds if seed in finished), a.seeds[0])
    print(f"Pictures and videos: {gallery.write(a.results, a.scenarios, a.methods, seed, collected, a.output)}")
    return 0


def _track_init(a: argparse.Namespace) -> int:
    from neuspring.core.files import write_text
    from neuspring.experiments.tracking import log as tracking

    outcome = tracking.init(a.results, read_settings(a.settings).tracking)
    write_text(a.output, json.dumps(outcome, indent=1, sort_keys=True) + "\n")
    print(f"MLflow: {outcome['outcome']}")
    return 0


def _log(a: argparse.Namespace) -> int:
    from neuspring.core.files import write_text
    from neuspring.experiments.tracking import log as tracking

    outcome = tracking.log_run(a.record, a.results, read_settings(a.settings).tracking)
    write_text(a.output, outcome + "\n")
    print(f"MLflow: {a.record}: {outcome}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="neuspring", description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="command")
    add = Adder(commands)

    add("capture", _capture, "synthetic scene or PhysTwin's raw layout -> capture folder", "scenario", "settings", "output")
    segment = add("segment", _segment, "one camera of a capture -> masks", "capture", "settings", "compute", "output")
    segment.add_argument("--camera", required=True)
    track = add("track", _track, "masks of one camera -> tracks of pixels", "capture", "settings", "compute", "output")
    track.add_argument("--camera", required=True)
    track.add_argument("--masks", type=Path, required=True, help="masks.json")
    lift = add(
        "lift", _lift, "masks and tracks of all cameras -> points in the world, shape prior", "capture", "settings", "output"
    )
    judge = add("judge", _judge, "what perception made of a synthetic capture -> its errors", "capture", "settings", "output")
    for command in (lift, judge):
        command.add_argument(
            "--masks", type=Path, nargs="+", required=True, help="masks.json of every camera, in the capture's order"
        )
        command.add_argument("--tracks", type=Path, nargs="+", required=True, help="tracks.json of every camera, in the same order")
    judge.add_argument("--lifted", type=Path, required=True, help="lifted.json")
    judged = add("perception-table", _perception_table, "errors of perception, per category", "output")
    judged.add_argument("--results", type=Path, required=True)
    judged.add_argument("--scenarios", required=True, help="names and categories, as JSON")

    observe = add("observe", _observe, "capture -> observations.npz", "scenario", "settings", "output")
    observe.add_argument("--capture", type=Path, help="capture.json of raw video")
    observe.add_argument("--lifted", type=Path, help="lifted.json of raw video")

    learn = add("appearance", _appearance, "frame 0 of a capture -> splats", "capture", "settings", "compute", "output")
    learn.add_argument("--observations", type=Path, help="observations.npz, of processed data")
    learn.add_argument("--seed", type=int, default=0)
    draw = add(
        "render",
        _render,
        "splats and trajectory -> pictures, scored and filmed",
        "capture",
        "observations",
        "settings",
        "compute",
        "output",
    )
    for command in (learn, draw):
        command.add_argument(
            "--masks", type=Path, nargs="+", required=True, help="masks.json of every camera, in the capture's order"
        )
    learn.add_argument("--lifted", type=Path, help="lifted.json, where perception made the observations")
    frames = add("draw", _draw, "splats and trajectory -> RGBA pictures of any camera", "capture", "settings", "compute", "output")
    frames.add_argument("--camera", required=True)
    frames.add_argument("--frames", type=int, nargs="+", help="all by default")
    frames.add_argument("--background", choices=("black", "white"), default="black")
    for command in (draw, frames):
        command.add_argument("--appearance", type=Path, required=True, help="appearance.json")
        command.add_argument("--rollout", type=Path, required=True, help="rollout.json")

    search = add("search", _search, "observations -> coarse twin, by CMA-ES", "observations", "settings", "compute", "output")
    search.add_argument("--clusters", type=int, default=1, help="regions of the topology with values of their own (1: uniform)")
    search.add_argument("--seed", type=int, default=0)

    fit = add("fit", _fit, "coarse twin -> fitted twin, by gradients", "observations", "settings", "compute", "output")
    fit.add_argument("--search", type=Path, required=True, help="search.json to start from")
    fit.add_argument(
        "--kind", choices=("springs", "field"), default="springs", help="train each spring, or the neural spring field"
    )

    rollout = add("rollout", _rollout, "twin -> trajectory over all frames", "observations", "compute", "output")
    twins = "search.json or fit.json that names the twin; of several, the mean of the trajectories"
    rollout.add_argument("--twin", type=Path, nargs="+", required=True, help=twins)
    carry = "correct the state at the last training frame by what was observed there, where training frames say that it helps"
    rollout.add_argument("--carry-over", action="store_true", help=carry)

    train = add("train", _train, "observations -> trained model of a baseline", "observations", "settings", "compute", "output")
    train.add_argument("--model", required=True, choices=("spring_gaus", "gs_dynamics"))
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--capture", type=Path, help="capture.json, where silhouettes are trained on")
    train.add_argument("--masks", type=Path, nargs="+", help="masks.json of every camera, in the capture's order, with --capture")
    predict = add("predict", _predict, "model of a baseline -> trajectory over all frames", "observations", "compute", "output")
    predict.add_argument("--model", required=True, choices=("spring_gaus", "gs_dynamics", "static", "controller_lbs"))
    predict.add_argument("--train", type=Path, help="train.json, of models that are trained")
    for command in (train, predict):
        command.add_argument("--appearance", type=Path, help="appearance.json of the splats that the model moves")

    transfer = add("transfer", _transfer, "twin -> scores on other recordings of the object", "settings", "compute", "output")
    learned = "search.json or fit.json that names the twin, or train.json of GS-Dynamics"
    transfer.add_argument("--twin", type=Path, required=True, help=learned)
    transfer.add_argument("--targets", type=Path, nargs="+", required=True, help="observations.npz of the other recordings")
    transfer.add_argument("--method", required=True)
    transfer.add_argument("--seed", type=int, default=0)

    score = add("score", _score, "trajectory -> scores, plots and run.json", "observations", "output")
    score.add_argument("--search", type=Path, help="search.json, if the method has that stage")
    score.add_argument("--fit", type=Path, help="fit.json, if the method has that stage")
    score.add_argument("--train", type=Path, help="train.json, if the method has that stage")
    score.add_argument("--rollout", type=Path, required=True, help="rollout.json")
    score.add_argument("--appearance", type=Path, help="appearance.json, if the scenario has images")
    score.add_argument("--render", type=Path, help="render.json, if the scenario has images")
    score.add_argument("--method", required=True)
    score.add_argument("--variant", default="{}", help="JSON: the method's switches")
    score.add_argument("--seed", type=int, default=0)

    table = add("tables", _tables, "run records -> tables", "results", "runs", "output")
    table.add_argument("--transfers", nargs="*", default=[], help="scenarios whose twins were rolled out on other recordings")
    table.add_argument("--baseline", help="method that others are compared with (default: the first)")
    add_left_out(table)

    add("track-init", _track_init, "prepare the MLflow store, once before any run is logged", "results", "settings", "output")
    log = add("log", _log, "log one run.json to MLflow", "results", "settings", "output")
    log.add_argument("--record", type=Path, required=True, help="run.json")
    cli_tools.add_commands(add)
    return parser
