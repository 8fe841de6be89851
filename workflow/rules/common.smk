# Validates the configuration before any job, and holds the helpers that rules use.
import atexit
import functools
import hashlib
import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

from neuspring import benchmark as benchmarks
from neuspring import config as settings
from neuspring import gpus, job, needs, plan, tune_space
from neuspring.data import phystwin, phystwin_raw
from neuspring.errors import InputError
from neuspring.job_records import FOLDER, STARTED, failure_lines, read_jobs
from neuspring.lpips_weights import configured
from neuspring.provenance import code_digest

ROOT = Path(workflow.basedir)
# On a cluster its scheduler hands out GPUs; Snakemake then counts jobs, not cores. Inside one of its jobs nothing is counted.
CLUSTER = workflow.resource_settings.nodes is not None or workflow.remote_exec


def checked_benchmark():
    """The validated configuration; a clear message and no traceback if it is wrong or the results folder is not writable."""
    try:
        benchmark = benchmarks.Benchmark.of(config, ROOT)
        if benchmark.config.tune:
            tune_space.Plan.of(benchmark.config, benchmark.config.tune, ROOT)
            needs.check_storage(benchmark.config.tune, cluster=CLUSTER)
        results = Path(benchmark.config.results)
        try:
            results.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=results).close()
        except OSError as error:
            raise InputError(
                f"configuration, results ({results})",
                "this folder must be writable",
                error.strerror,
                "Choose another: --config results=...",
            ) from error
        return benchmark
    except InputError as error:
        raise WorkflowError(str(error)) from None


BENCHMARK = checked_benchmark()
CONFIG = BENCHMARK.config
RESULTS = CONFIG.results
DEVICE = CONFIG.device


def checked_pool():
    """The GPUs of this machine that jobs lease. Too large a wish is an error here, before any job: Snakemake would clamp it."""
    if CLUSTER:
        return ()
    wanted = workflow.global_resources.get("gpu")
    limit = wanted.value if wanted else None
    try:
        dryrun = workflow.output_settings.dryrun
        pool = needs.gpu_pool(CONFIG.gpus, DEVICE, plan_only=dryrun)
        overwritten = workflow.resource_settings.overwrite_resources
        needs.check_gpus(overwritten, pool)
        if pool:
            slots = needs.gpu_slots(pool, CONFIG.gpus.jobs_per_gpu, limit)
            workflow.register_resource("gpu", slots)
        elif limit:
            raise InputError(
                "--resources gpu",
                "no job of this run can have a GPU",
                limit,
                "Leave it out, or set device: cuda where there is one.",
            )
    except InputError as error:
        raise WorkflowError(str(error)) from None
    return pool


POOL = checked_pool()
GPU = int(DEVICE == "cuda" or (DEVICE == "auto" and (CLUSTER or bool(POOL))))
NEEDS = needs.Needs(BENCHMARK, "gpu" if GPU else "cpu")
memory, search_work, fit_work = NEEDS.memory, NEEDS.search, NEEDS.fit
appearance_work, frame_work = NEEDS.appearance, NEEDS.scenario


def job_prefix():
    """What every job's shell begins with: the interpreter that runs Snakemake (unless conda provides one) and the GPUs to share.

    A prefix replaces Snakemake's own, without which a command that fails before a pipe would count as one that succeeded.
    """
    values = {
        # Only inside a job that a cluster started; with --jobs beside --cores Snakemake runs jobs here.
        job.POOL: job.GIVEN if workflow.remote_exec else ",".join(POOL),
        job.SHARE: str(CONFIG.gpus.jobs_per_gpu),
    }
    exports = "".join(
        f"export {name}={shlex.quote(value)}; " for name, value in values.items()
    )
    if not workflow.deployment_settings.deployment_method:
        exports += (
            f"export PATH={shlex.quote(str(Path(sys.executable).parent))}:$PATH; "
        )
    return f"set -euo pipefail; {exports}"


shell.prefix(job_prefix())


def wrapped(options, command):
    """A `neuspring` command in the wrapper that every job runs in: GPU lease, log, record, cause of failure (`neuspring.job`)."""
    run = "python -m neuspring.job --log {log:q} --attempt {resources.attempt}"
    return f"{run} {options} -- python -m neuspring {command}"


def common_job(command):
    return wrapped("--quiet", command)


def common_gpu_job(command):
    return wrapped("--gpus {resources.gpu}", command)


def scenario_job(command):
    return wrapped("--scenario {wildcards.scenario} --work {resources.work}", command)


def gpu_job(command):
    return wrapped(
        "--scenario {wildcards.scenario} --work {resources.work} --gpus {resources.gpu}",
        command,
    )


# No GPU waits for one of its jobs while cores are taken by jobs that need none.
GPU_FIRST = 10 * GPU


def attempt_number(wildcards, attempt):
    return attempt


def one(wildcards):
    return 1


def minutes(rule, default, work=None):
    return NEEDS.minutes(rule, default, work or one)


TABLE_FOLDER = f"{RESULTS}/{CONFIG.tables}"
TABLES = f"{TABLE_FOLDER}/summary.md"
REPORT = f"{TABLE_FOLDER}/report.html"
PERCEPTION_TABLE = f"{TABLE_FOLDER}/perception.md"


# Only for `--software-deployment-method conda`; without it the running environment is used.
ENVIRONMENT = str(ROOT / "workflow" / "envs" / "neuspring.yaml")


wildcard_constraints:
    scenario="|".join(map(re.escape, BENCHMARK.scenarios)),
    method="|".join(map(re.escape, BENCHMARK.methods | BENCHMARK.fits)),
    search="|".join(map(re.escape, BENCHMARK.searches)),
    camera=r"[A-Za-z0-9][A-Za-z0-9_.-]*",
    seed="|".join(map(str, BENCHMARK.whole.seeds)),
    study="|".join(map(re.escape, BENCHMARK.studies)),


def section(*names):
    """Sections of the configuration as the JSON text that a command takes."""
    return json.dumps(
        {name: settings.plain(CONFIG)[name] for name in names}, sort_keys=True
    )


def observe_settings(wildcards):
    source = BENCHMARK.scenarios[wildcards.scenario].source
    if source in settings.FILMED:
        return perception_settings("sample", "seed")
    names = {
        "toy": ["toy"],
        "mocap": ["data_root", "mocap"],
        "phystwin": ["data_root"],
    }
    return section(*names[source])


def perceived_options(wildcards, input):
    if BENCHMARK.scenarios[wildcards.scenario].source not in settings.FILMED:
        return []
    return ["--capture", str(input[0]), "--lifted", str(input[1])]


def scenario_row(wildcards):
    return json.dumps(
        settings.plain(BENCHMARK.scenarios[wildcards.scenario]), sort_keys=True
    )


def reader_digest(wildcards):
    source = BENCHMARK.scenarios[wildcards.scenario].source
    if source in settings.FILMED:
        return code_digest("neuspring.perception.sample", stage="perceive.assemble")
    return code_digest(f"neuspring.data.{source}")


def capture_file(wildcards):
    """capture.json of a scenario: the user's own, or one that the workflow makes."""
    return f"{BENCHMARK.capture_folder(wildcards.scenario)}/capture.json"


def raw_files(wildcards):
    """What a capture is imported from, so that changed data are read again."""
    source = BENCHMARK.scenarios[wildcards.scenario].source
    if source not in ("phystwin_raw", "phystwin"):
        return []
    folder = BENCHMARK.data_path(wildcards.scenario)
    return [
        str(folder / name) for name in phystwin_raw.FILES if (folder / name).exists()
    ]


def camera_files(wildcards, name):
    try:
        cameras = BENCHMARK.cameras(wildcards.scenario)
    except InputError:
        # Damaged data of one scenario end its own jobs, which say what is wrong, and nobody else's: not the planning of all.
        cameras = ["0"]
    return [
        f"{RESULTS}/{wildcards.scenario}/perception/{camera}/{name}"
        for camera in cameras
    ]


def judged_scenarios():
    """Scenarios of this run whose truth is known, and their categories."""
    rows = {name: BENCHMARK.scenarios[name] for name in CONFIG.scenarios}
    return {
        name: row.category for name, row in rows.items() if row.source == "synthetic"
    }


def judged_records():
    return [f"{RESULTS}/{name}/perception/judged.json" for name in judged_scenarios()]


def perception_arguments():
    return ["--results", RESULTS, "--scenarios", json.dumps(judged_scenarios())]


def perception_tables():
    return [PERCEPTION_TABLE] if judged_scenarios() else []


def of_source(*sources):
    """Pattern of the scenarios of some sources; where there are none it matches nothing."""
    rows = BENCHMARK.scenarios.values()
    names = [re.escape(row.scenario) for row in rows if row.source in sources]
    return "|".join(names) or "(?!)"


def truth_file(step):
    """The truth of a synthetic scene, if the step's backend reads it."""
    if getattr(CONFIG.perception, step).backend != "truth":
        return []
    return f"{RESULTS}/{{scenario}}/capture_truth.npz"


def image_stamps(wildcards):
    """A digest of names, sizes and times of the images that the user may change, so that changed ones are read again."""
    row = BENCHMARK.scenarios[wildcards.scenario]
    folder = BENCHMARK.data_path(wildcards.scenario)
    own = row.source in ("capture", "phystwin_raw", "phystwin")
    return stamps(str(folder)) if own else ""


@functools.cache
def stamps(folder):
    digest = hashlib.sha256()
    kinds = [Path(folder) / kind for kind in ("color", "depth", "mask")]
    for path in sorted(path for kind in kinds for path in kind.rglob("*")):
        # A link without target must not end the planning either: whoever reads it says so.
        facts = path.stat() if path.exists() else path.lstat()
        digest.update(f"{path} {facts.st_size} {facts.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


BACKENDS = {
    ("segment", "given"): "neuspring.data.capture",
    ("segment", "opencv"): "neuspring.perception.segment_opencv",
    ("segment", "grounded_sam2"): "neuspring.perception.segment_sam2",
    ("track", "opencv"): "neuspring.perception.track_opencv",
    ("track", "cotracker3"): "neuspring.perception.track_cotracker",
    ("track", "truth"): "neuspring.perception.track_truth",
}


def backend_digest(step):
    """The code of a step's chosen backend, and of the step."""
    backend = getattr(CONFIG.perception, step).backend
    return code_digest(BACKENDS[step, backend], stage=f"perceive.{step}")


def segment_backend(wildcards):
    """Processed data have masks; those are taken, whatever segments raw video."""
    processed = BENCHMARK.scenarios[wildcards.scenario].source == "phystwin"
    return "given" if processed else CONFIG.perception.segment.backend


def segment_settings(wildcards):
    if segment_backend(wildcards) != "given":
        return perception_settings("segment")
    return json.dumps({"perception": {"segment": {"backend": "given"}}})


def segment_digest(wildcards):
    return code_digest(
        BACKENDS["segment", segment_backend(wildcards)], stage="perceive.segment"
    )


def segment_gpu(wildcards):
    return int(segment_backend(wildcards) == "grounded_sam2" and GPU)


def perception_settings(*names):
    """Some sections of `perception`, with the chosen backend's own settings alone."""
    values = settings.plain(CONFIG)["perception"]
    chosen = {name: values[name] for name in names}
    for name in ("segment", "track"):
        if name in chosen:
            backend = chosen[name]["backend"]
            # The truth takes its count of points from the settings of opencv.
            own = "opencv" if backend == "truth" else backend
            chosen[name] = {
                key: value
                for key, value in chosen[name].items()
                if key in ("backend", own)
            }
    return json.dumps({"perception": chosen}, sort_keys=True)


def image_settings(*names):
    """Some keys of `images`, so that changing another one runs nothing again."""
    values = settings.plain(CONFIG)["images"]
    return json.dumps(
        {"images": {name: values[name] for name in names}}, sort_keys=True
    )


def appearance_settings(wildcards):
    """What trains splats; of processed data, which perception has not lifted, also how masks are lifted."""
    chosen = json.loads(image_settings("backend", "appearance"))
    quirks = settings.plain(CONFIG)["images"]["released_quirks"]
    chosen["images"]["released_quirks"] = {"corner_pixels": quirks["corner_pixels"]}
    if BENCHMARK.scenarios[wildcards.scenario].source not in settings.FILMED:
        chosen |= json.loads(perception_settings("lift"))
    return json.dumps(chosen, sort_keys=True)


def first_points(wildcards):
    """Where the first splats lie: perception's record, or the observations of processed data."""
    folder = f"{RESULTS}/{wildcards.scenario}"
    if BENCHMARK.scenarios[wildcards.scenario].source in settings.FILMED:
        return f"{folder}/perception/lifted.json"
    return f"{folder}/observations.npz"


def first_points_option(wildcards):
    filmed = BENCHMARK.scenarios[wildcards.scenario].source in settings.FILMED
    return "--lifted" if filmed else "--observations"


def lpips_weights():
    """Whether LPIPS can be computed, so that weights that come later are used."""
    found = configured(CONFIG.images.lpips)
    return "absent" if isinstance(found, str) else "found"


def appearance_records(wildcards):
    """The record of the splats, for scenarios with images."""
    if not BENCHMARK.has_images(wildcards.scenario):
        return []
    return [
        f"{RESULTS}/{wildcards.scenario}/appearance/{wildcards.seed}/appearance.json"
    ]


def render_records(wildcards):
    """The record of the drawn pictures, for scenarios with images; others have no such stage."""
    if not BENCHMARK.has_images(wildcards.scenario):
        return []
    return [
        f"{RESULTS}/{wildcards.scenario}/{wildcards.method}/{wildcards.seed}/render.json"
    ]


def picture_options(wildcards, input):
    if not input.get("render"):
        return []
    return ["--appearance", str(input.appearance), "--render", str(input.render)]


def track_gpu():
    return int(CONFIG.perception.track.backend == "cotracker3" and GPU)


def scenario_files(wildcards):
    """The capture's files, so that changed data are read again."""
    if BENCHMARK.scenarios[wildcards.scenario].source in settings.FILMED:
        return [
            capture_file(wildcards),
            f"{RESULTS}/{wildcards.scenario}/perception/lifted.json",
        ]
    path = BENCHMARK.data_path(wildcards.scenario)
    if path is None:
        return []
    if path.is_file():
        return [str(path)]
    return [str(path / name) for name in phystwin.FILES if (path / name).exists()]


def search_settings(wildcards):
    return settings_of_search(wildcards.search)


@functools.cache
def settings_of_search(name):
    """The search's sections, with the search row's own settings on top."""
    chosen = common_settings()
    row = BENCHMARK.searches[name]
    chosen["search"] = settings.plain(benchmarks.search_of(CONFIG, row, name))
    if row.clusters == 1:
        # What concerns regions alone changes nothing here, so it must not start the search again.
        for name in ("clusters", "tied_rollouts", "freed_sigma"):
            del chosen["search"][name]
    return json.dumps(chosen, sort_keys=True)


def common_settings():
    """What search and fit share."""
    values = settings.plain(CONFIG)
    return {name: values[name] for name in ("simulation", "losses", "released_quirks")}


def fit_settings(wildcards):
    return settings_of_fit(wildcards.method)


@functools.cache
def settings_of_fit(name):
    """The fit's sections, with the method's own settings on top."""
    chosen = common_settings()
    method = BENCHMARK.fits[name]
    chosen["fit"] = settings.plain(benchmarks.fit_of(CONFIG, method, name))
    if method.fit == "springs":
        del chosen["fit"]["field"]
    return json.dumps(chosen, sort_keys=True)


def search_record(wildcards):
    method = (BENCHMARK.methods | BENCHMARK.fits)[wildcards.method]
    return f"{RESULTS}/{wildcards.scenario}/search-{method.search}/{wildcards.seed}/search.json"


def fit_records(wildcards):
    """The fit's record if the method has that stage, else nothing. Methods with the same fit share it."""
    owner = BENCHMARK.fit_of_method.get(wildcards.method)
    return (
        [f"{RESULTS}/{wildcards.scenario}/{owner}/{wildcards.seed}/fit.json"]
        if owner
        else []
    )


def twin_record(wildcards):
    """The record that names the method's final twin: a stage left out is a shorter path, not a branch in code."""
    return (fit_records(wildcards) or [search_record(wildcards)])[0]


def rollout_twins(wildcards):
    """The records whose trajectories a prediction is made of: one, or those of all seeds, whatever part of them runs now."""
    if not BENCHMARK.methods[wildcards.method].average_seeds:
        return [twin_record(wildcards)]
    return [
        twin_record(
            SimpleNamespace(
                scenario=wildcards.scenario, method=wildcards.method, seed=seed
            )
        )
        for seed in BENCHMARK.whole.seeds
    ]


def fit_option(wildcards, input):
    return ["--fit", str(input.fit)] if input.get("fit") else []


def carry_option(wildcards):
    return "--carry-over" if BENCHMARK.methods[wildcards.method].carry_over else ""


def variant(wildcards):
    return variant_of(wildcards.method)


@functools.cache
def variant_of(name):
    """The switches of a method, for its record."""
    method = BENCHMARK.methods[name]
    row = settings.plain(method)
    return json.dumps(
        {
            "search": method.search,
            "clusters": BENCHMARK.searches[method.search].clusters,
            "fit": method.fit or "none",
            "carry_over": method.carry_over,
            "average_seeds": method.average_seeds,
            **row["settings"],
        },
        sort_keys=True,
    )


def transfer_targets(wildcards):
    return [
        f"{RESULTS}/{target}/observations.npz"
        for target in BENCHMARK.transfers[wildcards.scenario]
    ]


def transfer_records():
    """One per source, method and seed. Carrying over and averaging concern the same recording's future, not another one."""
    methods = [
        name
        for name, method in BENCHMARK.methods.items()
        if not (method.carry_over or method.average_seeds)
    ]
    return expand(
        "{results}/{scenario}/{method}/{seed}/transfer.json",
        results=RESULTS,
        scenario=BENCHMARK.transfers,
        method=methods,
        seed=CONFIG.seeds,
    )


def run_records(methods=CONFIG.methods):
    return expand(
        "{results}/{scenario}/{method}/{seed}/run.json",
        results=RESULTS,
        scenario=CONFIG.scenarios,
        method=methods,
        seed=CONFIG.seeds,
    )


def tracked_runs():
    return (
        [path.replace("run.json", "mlflow.txt") for path in run_records()]
        if CONFIG.tracking.enabled
        else []
    )


def study_table(name):
    return f"{TABLE_FOLDER}/studies/{name}.md"


def study_arguments(wildcards):
    return [
        "--study",
        wildcards.study,
        "--table",
        str(ROOT / CONFIG.study_table),
        *benchmark_arguments(f"{TABLE_FOLDER}/studies"),
    ]


def study_definition(wildcards):
    """A study's rows, so that changed ones make its table again."""
    return json.dumps(settings.plain(BENCHMARK.studies[wildcards.study]))


def transfer_option():
    whole = BENCHMARK.whole
    sources = [name for name in whole.transfers or {} if name in whole.scenarios]
    return ["--transfers", *sources] if sources else []


def benchmark_arguments(output):
    """The results folder, and which runs it is to hold in the end, whatever part of them is run now."""
    whole = BENCHMARK.whole
    return [
        *("--results", RESULTS, "--output", output),
        *("--scenarios", *whole.scenarios),
        *("--methods", *whole.methods, "--seeds", *map(str, whole.seeds)),
    ]


def table_arguments(output=TABLE_FOLDER):
    return [
        *benchmark_arguments(output),
        *transfer_option(),
        *("--baseline", BENCHMARK.compared_with),
    ]


def tell_plan():
    """How much time the run is expected to take."""
    slots = {
        "cpu": 0 if CLUSTER else workflow.cores,
        "gpu": workflow.global_resources["gpu"].value if POOL else 0,
    }
    jobs = needs.planned(
        workflow.dag.needrun_jobs(exclude_finished=False), Path(RESULTS)
    )
    print(plan.report(jobs, NEEDS.history, slots), flush=True)
    if GPU and not CLUSTER and not POOL:
        print(
            "There is no GPU here: device: cuda will be refused when this is no dry run."
        )


def begin():
    """Leave a mark by which jobs tell this run's attempts from earlier ones."""
    mark = Path(RESULTS) / FOLDER / STARTED
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    tell_plan()


def tell_plan_of_dry_run():
    # Snakemake has no hook for the end of a dry run.
    if workflow.dryrun and workflow.dag:
        tell_plan()


if workflow.is_main_process:
    atexit.register(tell_plan_of_dry_run)


TUNE_FOLDER = f"{RESULTS}/tune/{CONFIG.tune.study}" if CONFIG.tune else ""


def sweep_summaries():
    """The summary of the tuning study, if the configuration has one."""
    return [f"{TUNE_FOLDER}/summary.md"] if CONFIG.tune else []


def sweep_targets(wildcards):
    if not CONFIG.tune:
        raise WorkflowError(
            "The target sweep needs a study: the section `tune` of the configuration (config/README.md, config/tune.yaml)."
        )
    logged = [f"{TUNE_FOLDER}/mlflow.txt"] if CONFIG.tracking.enabled else []
    return [*sweep_summaries(), *logged]


def finished_sweeps():
    """A study costs much and is not asked for by `all`; the report shows one that is there."""
    # Not an input: changed settings would then run the whole study again.
    found = [Path(path) for path in sweep_summaries() if Path(path).exists()]
    return [hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in found]


def tune_settings():
    """What a study's workers need; its tables of methods and searches are found wherever a job runs."""
    names = ("simulation", "losses", "search", "fit", "released_quirks", "tune")
    tables = {
        name: str(ROOT / getattr(CONFIG, name))
        for name in ("method_table", "search_table")
    }
    chosen = json.loads(section(*names, "scenarios")) | tables
    return json.dumps(chosen, sort_keys=True)


def tuned_rows():
    """The rows of the method that is varied, so that changed ones are tuned again."""
    method = benchmarks.read_methods(ROOT / CONFIG.method_table)[CONFIG.tune.method]
    search = benchmarks.read_searches(ROOT / CONFIG.search_table)[method.search]
    rows = [settings.plain(method), settings.plain(search)]
    return json.dumps(rows, sort_keys=True)


def template_digest():
    """Of the report's templates, which the digest of its code does not hold."""
    folder = Path(needs.__file__).parent / "report" / "templates"
    texts = [path.read_bytes() for path in sorted(folder.iterdir())]
    return hashlib.sha256(b"".join(texts)).hexdigest()[:16]


def report_arguments(output=REPORT):
    values = settings.plain(BENCHMARK.whole) | {"only": ""}
    # Where MLflow lies concerns nothing that the report shows.
    del values["tracking"]
    return [
        *("--results", RESULTS, "--output", output),
        *("--settings", json.dumps(values, sort_keys=True)),
        *("--table", str(ROOT / CONFIG.study_table), "--tables", CONFIG.tables),
        *("--baseline", BENCHMARK.compared_with),
        *transfer_option(),
    ]


def tell_failures():
    """What failed and why; the report says the same."""
    damaged = []
    lines = failure_lines(read_jobs(Path(RESULTS), damaged), Path(RESULTS)) + damaged
    print("\n".join(["Failed:", *(f"  {line}" for line in lines)] if lines else []))
    print(
        f"Report so far: {TABLE_FOLDER}/so_far/report.html. The same command continues where this one stopped.",
        flush=True,
    )


def report_end(failed):
    """Print the table of what is finished and what to do next, also after an interruption."""
    if failed:
        print("\nThe run did not finish. What is done so far:", flush=True)
        # In a folder of its own: had the tables a file in place, the next run would find nothing to be done.
        command = [sys.executable, "-m", "neuspring", "tables"]
        so_far = f"{TABLE_FOLDER}/so_far"
        subprocess.run([*command, *table_arguments(so_far)], check=False)
        command[-1] = "report"
        page = report_arguments(f"{so_far}/report.html")
        subprocess.run([*command, *page], check=False, stdout=subprocess.DEVNULL)
        tell_failures()
        return
    if not Path(TABLES).exists():
        return
    print(f"\n{Path(TABLES).read_text()}")
    print(
        f"Scores, trajectories, plots: {RESULTS}/<scenario>/<method>/<seed>/ (run.json names the twin), tables: {RESULTS}/{CONFIG.tables}/"
    )
    print(
        f"Open in a browser: {REPORT} (everything), {TABLE_FOLDER}/pictures.html (videos of every method)"
    )
    tell_tracking()


def tell_tracking():
    if not CONFIG.tracking.enabled:
        return
    neuspring = Path(sys.executable).parent / "neuspring"
    given = (
        f" --settings {shlex.quote(section('tracking'))}" if CONFIG.tracking.uri else ""
    )
    waiting = [
        path
        for path in tracked_runs()
        if Path(path).exists() and "logged" not in Path(path).read_text()
    ]
    if waiting:
        print(
            f"{len(waiting)} runs could not be logged ({Path(waiting[0]).read_text().strip()}). Their records wait on disk; send them:"
        )
        print(f"  {neuspring} sync --results {shlex.quote(RESULTS)}{given}")
    print(
        f"Look at the runs in MLflow:\n  {neuspring} ui --results {shlex.quote(RESULTS)}{given}",
        flush=True,
    )
