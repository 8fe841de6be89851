# What the rules of tables, studies and the report ask: which runs they are made of.
def run_records(methods=CONFIG.methods):
    return [
        f"{RESULTS}/{scenario}/{method}/{seed}/run.json"
        for scenario in CONFIG.scenarios
        for method in methods
        if BENCHMARK.applies(method, scenario)
        for seed in CONFIG.seeds
    ]


def tracked_runs(methods=CONFIG.methods):
    return (
        [path.replace("run.json", "mlflow.txt") for path in run_records(methods)]
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


def left_out_option():
    """Which methods do not apply to which scenarios, so that nothing is missing there."""
    left_out = BENCHMARK.whole_left_out
    return ["--left-out", json.dumps(left_out, sort_keys=True)] if left_out else []


def benchmark_arguments(output):
    """The results folder, and which runs it is to hold in the end, whatever part of them is run now."""
    whole = BENCHMARK.whole
    return [
        *("--results", RESULTS, "--output", output),
        *("--scenarios", *whole.scenarios),
        *("--methods", *whole.methods, "--seeds", *map(str, whole.seeds)),
        *left_out_option(),
    ]


def table_arguments(output=TABLE_FOLDER):
    return [
        *benchmark_arguments(output),
        *transfer_option(),
        *("--baseline", BENCHMARK.compared_with),
    ]


def template_digest():
    """Of the report's templates, which the digest of its code does not hold."""
    folder = ROOT / "neuspring" / "report" / "page" / "templates"
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
        *left_out_option(),
    ]
