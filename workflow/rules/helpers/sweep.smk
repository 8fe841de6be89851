# What the rules of tuning studies ask.
TUNE_FOLDER = f"{RESULTS}/tune/{CONFIG.tune.study}" if CONFIG.tune else ""


def sweep_summaries():
    """The summary of the tuning study, if the configuration has one."""
    return [f"{TUNE_FOLDER}/summary.md"] if CONFIG.tune else []


def sweep_targets(wildcards):
    if not CONFIG.tune:
        raise WorkflowError(
            "The target sweep needs a study: the section `tune` of the configuration (config/README.md, config/studies/tune.yaml)."
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
    chosen = json.loads(section(*names)) | tables
    chosen["scenarios"] = list(BENCHMARK.whole.scenarios)
    return json.dumps(chosen, sort_keys=True)


def tuned_rows():
    """The rows of the method that is varied, so that changed ones are tuned again."""
    method = benchmarks.read_methods(ROOT / CONFIG.method_table)[CONFIG.tune.method]
    search = benchmarks.read_searches(ROOT / CONFIG.search_table)[method.search]
    rows = [settings.plain(method), settings.plain(search)]
    return json.dumps(rows, sort_keys=True)
