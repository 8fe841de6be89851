# What the rules from captures to observations ask: files of a scenario, settings and code of the chosen backends.
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
        return code_digest("neuspring.perception.sample", stage="stages.perceive.assemble")
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


def judged_scenarios(names=CONFIG.scenarios):
    """Scenarios whose truth is known, and their categories."""
    rows = {name: BENCHMARK.whole_scenarios[name] for name in names}
    return {
        name: row.category for name, row in rows.items() if row.source == "synthetic"
    }


def judged_records():
    return [f"{RESULTS}/{name}/perception/judged.json" for name in judged_scenarios()]


def perception_arguments():
    everyone = judged_scenarios(BENCHMARK.whole.scenarios)
    return ["--results", RESULTS, "--scenarios", json.dumps(everyone)]


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
    return code_digest(BACKENDS[step, backend], stage=f"stages.perceive.{step}")


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
        BACKENDS["segment", segment_backend(wildcards)], stage="stages.perceive.segment"
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
