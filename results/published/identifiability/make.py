"""Recovery of a known stiffness by fits of free springs and of a neural spring field on toy scenes.

    python -m results.published.identifiability.make OUTPUT_FOLDER [--epochs N] [--seeds 0 1 2] [--scenes ...] [--jobs 2]

A fit starts from the true topology, dashpots, drag, contact and substeps. Only its stiffness is wrong: 0.6 of the truth's
geometric mean everywhere. The fit trains only the stiffness, without bounds. All kinds have the same settings except for the
learning rate. Seeds vary noise, occlusion and the field's initial weights.

Learning rates were chosen by the training loss on cloth/shake/smooth (0.5 mm, seed 0, 80 epochs; mm^2 of a rollout): springs 1.65
at 1e-2, 1.17 at 2e-2, 1.05 at 3e-2; field 1.48 at 1e-3, 1.31 at 2e-3, 1.43 at 3e-3. The truth has 0.89, the start 50. With
output_bound 1.5 the best values are 1.13 and 1.38, with a cosine schedule in addition 1.44 and 1.34.

Metrics of object springs:

- Pearson correlation with the truth and RMS error of log10 stiffness (decades), per spring and for the mean around each node. The
  mean does not require single springs to be identifiable.
- The RMS error split into a smooth part (the mean of the node errors at a spring's two ends) and the rough rest.
- Training loss (m^2) of a rollout, and track error (m) of future frames against the true motion.

For scale, the kinds `truth`, `start` and `constant` (the truth's geometric mean everywhere) are scored too. `shuffled` is a field
at permuted midpoints.

Writes identifiability.csv, .md and .png. Finished runs are in runs/ and are not repeated with the same settings; remove them if the
code changes.
"""

from __future__ import annotations

import argparse
import functools
import io
import itertools
import json
import multiprocessing
import time
from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib import pyplot as plt
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from neuspring import config
from neuspring.core.artifacts import Twin
from neuspring.core.errors import NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.table import Table
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.draw.sheet import save
from neuspring.draw.twin import STIFFNESS_COLORS, TwinPicture
from neuspring.scenes import toy
from neuspring.scenes.sources import read_scenarios
from neuspring.scores import metrics
from neuspring.scores.statistics import paired_differences
from neuspring.twin.fit import FitProblem, fit
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import roll_out

SCENES = tuple(f"{shape}/shake/{law}" for shape in ("rope", "cloth", "blob") for law in ("smooth", "two_region"))
NOISES = (0.0, 0.0005, 0.002)
"""Standard deviations of the observation noise, m."""
LIMITS = (0.3, 1 / 0.3)
"""Range of colors: stiffness over the geometric mean of the truth."""
SHOWN = (0.0005, 0)
"""Noise [m] and seed of the figure."""
CONSTANTS = {"start": 0.6, "constant": 1.0}
"""Homogeneous stiffness as a fraction of the truth's geometric mean."""
RATES = {"springs": 3e-2, "field": 2e-3, "shuffled": 2e-3}
"""Fitted kind -> learning rate. shuffled: a field at permuted midpoints."""
KINDS = ("truth", *CONSTANTS, *RATES)
METRICS = {
    "correlation": ("r, springs", 1.0, 2),
    "rms": ("RMS, springs [dec]", 1.0, 3),
    "node_correlation": ("r, nodes", 1.0, 2),
    "node_rms": ("RMS, nodes [dec]", 1.0, 3),
    "smooth_rms": ("RMS, smooth part [dec]", 1.0, 3),
    "rough_rms": ("RMS, rough part [dec]", 1.0, 3),
    "training_loss": ("training loss [mm²]", 1e6, 3),
    "future_track_error": ("future track error [mm]", 1e3, 2),
}
"""Metric -> heading, factor to the unit shown, decimals."""


@dataclass(frozen=True)
class Run:
    """One fit, or the evaluation of the truth or of a constant stiffness; noise in m."""

    scene: str
    noise: float
    seed: int
    kind: str
    epochs: int

    @property
    def name(self) -> str:
        return f"{self.scene.replace('/', '-')}_{1e3 * self.noise:g}mm_seed{self.seed}_{self.kind}"

    @property
    def fit(self) -> config.Fit:
        """Settings of the fit; the gradient goes through ten frames, and contact parameters hardly change."""
        rate = RATES.get(self.kind, 1.0)
        field = config.SpringFieldSettings(shuffled=self.kind == "shuffled")
        return config.Fit(epochs=self.epochs, learning_rate=rate, horizon=10, field=field)

    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as plain values."""
        identity = {"scene": self.scene, "noise": self.noise, "seed": self.seed, "kind": self.kind, "constants": CONSTANTS}
        return identity | ({"fit": config.plain(self.fit)} if self.kind in RATES else {})

    def record(self, folder: Path) -> dict[str, Any] | None:
        """Record in `folder` of a finished run with the same settings; None without one."""
        path = folder / f"{self.name}.json"
        record: dict[str, Any] | None = json.loads(path.read_text()) if path.is_file() else None
        return record if record and record["settings"] == self.settings() else None


@functools.cache
def scene_of(path: str, noise: float, seed: int) -> toy.ToyScene:
    """The toy scene observed with `noise` [m]."""
    rows = read_scenarios(Path(__file__).parents[3] / "config/scenarios.tsv")
    return toy.make(rows[f"toy_{path.replace('/', '_')}"], toy.ToyObservation(noise=noise, seed=seed))


def constant(truth: Twin, fraction: float) -> Twin:
    """The truth with the same stiffness everywhere: a fraction of its geometric mean."""
    stiffness = np.full_like(truth.material.stiffness, fraction * np.exp(np.log(truth.material.stiffness).mean()))
    return replace(truth, material=replace(truth.material, stiffness=stiffness))


def compare(twin: Twin, scene: toy.ToyScene) -> dict[str, float]:
    """Metrics of a twin (see the module); undefined ones, such as the correlation of a constant, are left out."""
    topology, seen = scene.truth.topology, scene.observations
    count, values = topology.object_spring_count, {}
    log = np.log10([np.asarray(one.material.stiffness[:count], np.float64) for one in (twin, scene.truth)])
    # A row per node with ones for its springs; a node may have none.
    incidence = np.zeros((len(topology.nodes), count))
    incidence[topology.springs[:count].T, np.arange(count)] = 1.0
    incidence = incidence[incidence.any(axis=1)]
    average = incidence / incidence.sum(axis=1, keepdims=True)
    around = log @ average.T
    for prefix, (recovered, true) in {"": log, "node_": around}.items():
        values[f"{prefix}rms"] = float(np.sqrt(np.mean((recovered - true) ** 2)))
        if recovered.std() > 1e-9:
            values[f"{prefix}correlation"] = float(np.corrcoef(recovered, true)[0, 1])
    error = log[0] - log[1]
    smooth = incidence.T @ (average @ error) / 2
    values |= {"smooth_rms": float(np.sqrt(np.mean(smooth**2))), "rough_rms": float(np.sqrt(np.mean((error - smooth) ** 2)))}
    trajectory = roll_out(twin, seen.controller_points)
    loss, end = FrameLoss.of(seen, config.Losses(), "cpu"), seen.scenario.train_end
    if len(trajectory.positions) >= end:
        values["training_loss"] = float(np.mean([float(loss(t, torch.tensor(trajectory.positions[t]))) for t in range(1, end)]))
    scores = metrics.score(trajectory, seen, "", 0).set_index(["task", "metric"])["value"]
    return values | ({"future_track_error": float(scores["future", "track_error"])} if "future" in scores else {})


def execute(run: Run, folder: Path) -> dict[str, Any]:
    """Execute a run; write and return its record: settings, metrics, stiffness of the object springs [N], history of the fit."""
    torch.set_num_threads(1)
    clock = time.perf_counter()
    scene = scene_of(run.scene, run.noise, run.seed)
    twin = scene.truth if run.kind == "truth" else constant(scene.truth, CONSTANTS.get(run.kind, CONSTANTS["start"]))
    record: dict[str, Any] = {"settings": run.settings(), "values": {}, "stiffness": []}
    try:
        if run.kind in RATES:
            problem = FitProblem(
                observations=scene.observations,
                twin=twin,
                fit=run.fit,
                simulation=config.SimulationSettings(),
                losses=config.Losses(),
                quirks=config.ReleasedQuirks(),
                kind="springs" if run.kind == "springs" else "field",
                seed=run.seed,
            )
            with redirect_stderr(io.StringIO()):
                result = fit(problem)
            twin = result.twin
            record |= {
                "best_epoch": result.facts["best_epoch"],
                "rollbacks": result.facts["rollbacks"],
                "losses": list(result.history["loss"]),
            }
        record |= {"values": compare(twin, scene), "substeps": twin.simulation.substeps}
        record["stiffness"] = [float(f"{y:.6g}") for y in twin.material.stiffness[: scene.truth.topology.object_spring_count]]
    except NumericalFailure as failure:
        record["failure"] = str(failure)
    record["seconds"] = time.perf_counter() - clock
    write_text(folder / f"{run.name}.json", json.dumps(record) + "\n")
    return record


def execute_all(runs: list[Run], folder: Path, jobs: int) -> list[dict[str, Any]]:
    """Records of all runs, in order; `jobs` processes execute the missing ones."""
    todo, clock = [run for run in runs if run.record(folder) is None], time.perf_counter()
    print(f"{len(runs) - len(todo)} of {len(runs)} runs exist, {len(todo)} are missing", flush=True)
    with multiprocessing.get_context("spawn").Pool(jobs) if jobs > 1 else ThreadPool(jobs) as pool:
        records = pool.imap(functools.partial(execute, folder=folder), todo)
        for done, (run, record) in enumerate(zip(todo, records, strict=True), 1):
            text = ", ".join(f"{name} {value:.3g}" for name, value in record["values"].items()) or record["failure"]
            elapsed = time.perf_counter() - clock
            left = elapsed / done * (len(todo) - done)
            print(f"{done}/{len(todo)} [{elapsed:.0f} s, {left:.0f} s left] {run.name}: {text}", flush=True)
    return [run.record(folder) or {} for run in runs]


def report(table: pd.DataFrame) -> list[str]:
    """Tables in Markdown: every kind and paired differences per scene and noise, then differences over all scenes."""

    def cell(metric: str, values: pd.Series, sign: str) -> str:
        _, factor, digits = METRICS[metric]
        spread = f" ± {factor * values.std():.{digits}f}" if len(values) > 1 else ""
        return f"{factor * values.mean():{sign}.{digits}f}{spread}" if len(values) else "–"

    rows = []
    for (scene, noise), part in table.groupby(["scene", "noise"], sort=False):
        wide = part.pivot(index=["metric", "seed"], columns="kind", values="value").reindex(columns=KINDS)
        for kind in list(RATES)[1:]:
            wide[f"{kind} − springs"] = wide[kind] - wide["springs"]
        for kind, values in wide.items():
            sign, of = "+" if "−" in str(kind) else "", wide.index.get_level_values(0)
            cells = [cell(metric, values[of == metric].dropna(), sign) for metric in METRICS]
            rows.append([str(scene), f"{1e3 * float(noise):g}", str(kind), *cells])
    headings = [heading for heading, _, _ in METRICS.values()]
    lines = Table.of_texts(["scene", "noise [mm]", "kind", *headings], rows).markdown()
    fits = table[table["kind"].isin(list(RATES))].rename(columns={"scene": "scenario", "kind": "method"})
    both = pd.concat([fits.assign(task=[f"{1e3 * noise:g}" for noise in fits["noise"]]), fits.assign(task="all")])
    differences, rows = paired_differences(both, "springs"), []
    for (kind, task), part in differences.groupby(["method", "task"], sort=False) if len(differences) else []:
        by, cells = part.set_index("metric"), [str(kind), str(task)]
        for metric, (_, factor, digits) in METRICS.items():
            of = by.reindex([metric]).iloc[0]
            cells.append("{:+.{d}f} [{:+.{d}f}, {:+.{d}f}]".format(*(factor * of[["difference", "low", "high"]]), d=digits))
        rows.append(cells)
    lines += ["", "Difference to springs at the same scene, noise and seed [95 % bootstrap interval over scenes and seeds]:", ""]
    return lines + Table.of_texts(["kind", "noise [mm]", *headings], rows).markdown()


def picture(scenes: dict[str, dict[str, np.ndarray]]) -> Figure:
    """Figure with a row per scene: the truth and every fit at rest, colored by stiffness, and recovered over true stiffness.

    `scenes` is scene -> kind -> stiffness [N] of the object springs; it is shown relative to the truth's geometric mean.
    """
    figure, axes = plt.subplots(len(scenes), 5, figsize=(17, 2.9 * len(scenes) + 1), squeeze=False, layout="constrained")
    for row, (scene, kinds) in zip(axes, scenes.items(), strict=True):
        truth, unit = scene_of(scene, *SHOWN).truth, np.exp(np.log(kinds["truth"]).mean())
        seen = ShownScene.from_side(scene_of(scene, *SHOWN).observations, [], [0])
        for axis, kind in zip(row, ("truth", *RATES), strict=False):
            stiffness = truth.material.stiffness.copy()
            stiffness[: len(kinds[kind])] = kinds[kind] / unit
            material = replace(truth.material, stiffness=stiffness)
            take = ShownRun(kind, truth.topology.nodes[None], replace(truth, material=material))
            TwinPicture([(seen, take)], 0, ("stiffness",), limits=LIMITS).paint(axis, seen, take, "stiffness")
            axis.set_aspect("equal")
            axis.set_title(f"{scene}: {kind}", fontsize=10)
        for kind, color, shift in zip(RATES, ("tab:orange", "tab:blue", "tab:green"), (-0.014, 0.0, 0.014), strict=True):
            true, recovered = np.log10(kinds["truth"] / unit), np.log10(kinds[kind] / unit)
            label = f"{kind}, r = {np.corrcoef(true, recovered)[0, 1]:.2f}"
            row[-1].scatter(true + shift, recovered, s=5, color=color, alpha=0.35, lw=0, label=label)
        row[-1].plot([-0.35, 0.35], [-0.35, 0.35], color="black", lw=0.8, label="equal")
        row[-1].axhline(np.log10(kinds["start"][0] / unit), color="0.4", ls=":", lw=1, label="start")
        row[-1].set(xlabel="log$_{10}$ true / mean (kinds side by side)", ylabel="log$_{10}$ recovered / mean", ylim=(-1.1, 1.1))
        for handle in row[-1].legend(fontsize=7, markerscale=3, ncols=2, loc="lower right").legend_handles:
            handle.set_alpha(1.0)
    label = "stiffness / geometric mean of the truth"
    ticks: dict[str, Any] = {"ticks": [0.3, 0.5, 1, 2, 3], "format": "{x:g}", "extend": "both"}
    figure.colorbar(
        ScalarMappable(LogNorm(*LIMITS), STIFFNESS_COLORS),
        ax=axes,
        label=label,
        location="bottom",
        aspect=60,
        shrink=0.6,
        pad=0.01,
        **ticks,
    ).minorticks_off()
    figure.suptitle(f"Stiffness of object springs, noise {1e3 * SHOWN[0]:g} mm, seed {SHOWN[1]}")
    return figure


def main() -> None:
    """Execute missing runs, then write the tables and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--epochs", type=int, default=80)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="shape/motion/law, as in config/scenarios.tsv")
    parser.add_argument("--noises", type=float, nargs="+", default=NOISES, help="m")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    runs = [Run(*one, options.epochs) for one in itertools.product(options.scenes, options.noises, options.seeds, KINDS)]
    records = execute_all(runs, options.output / "runs", options.jobs)
    rows, shown, failed = [], {}, []
    for run, record in zip(runs, records, strict=True):
        rows += [(run.scene, run.noise, run.seed, run.kind, metric, value) for metric, value in record["values"].items()]
        failed += [f"\nFailed: {run.name}: {record['failure']}"] if "failure" in record else []
        if (run.noise, run.seed) == SHOWN and record["stiffness"]:
            shown.setdefault(run.scene, {})[run.kind] = np.array(record["stiffness"])
    table = pd.DataFrame(rows, columns=["scene", "noise", "seed", "kind", "metric", "value"])
    write_text(options.output / "identifiability.csv", table.to_csv(index=False))
    rates = " and ".join(f"{rate:g} ({kind})" for kind, rate in RATES.items())
    head = f"Mean ± standard deviation over {len(options.seeds)} seed(s); {options.epochs} epochs, learning rates {rates}.\n"
    text = "\n".join([head, *report(table), *failed]) + "\n"
    write_text(options.output / "identifiability.md", text)
    shown = {scene: kinds for scene, kinds in shown.items() if len(kinds) == len(KINDS)}
    if shown:
        save(picture(shown), options.output / "identifiability.png")
    print(text)


if __name__ == "__main__":
    main()
