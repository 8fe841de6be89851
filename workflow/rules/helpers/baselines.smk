# What the rules of the baselines' models ask: which methods have one, its settings, the splats that it moves.
def methods_with(*models):
    """Pattern of the methods whose model is one of these; where there are none it matches nothing."""
    rows = BENCHMARK.methods.items()
    names = [re.escape(name) for name, row in rows if row.model in models]
    return "|".join(names) or "(?!)"


def methods_with_search():
    names = [re.escape(name) for name, row in BENCHMARK.methods.items() if row.search]
    return "|".join(names) or "(?!)"


def train_settings(wildcards):
    return settings_of_training(wildcards.method)


@functools.cache
def settings_of_training(name):
    """A model's section, with the method's own settings on top, and what else its training reads."""
    method, values = BENCHMARK.methods[name], settings.plain(CONFIG)
    model = benchmarks.model_of(CONFIG, method, name)
    chosen = {"baselines": {method.model: settings.plain(model)}}
    if method.model == "spring_gaus":
        chosen["simulation"] = {"gravity": values["simulation"]["gravity"]}
        if name in BENCHMARK.pictured:
            images = values["images"]
            quirks = {"corner_pixels": images["released_quirks"]["corner_pixels"]}
            chosen["images"] = {
                "backend": images["backend"],
                "released_quirks": quirks,
            }
        else:
            chosen["losses"] = values["losses"]
    return json.dumps(chosen, sort_keys=True)


def model_of(wildcards):
    return BENCHMARK.methods[wildcards.method].model


def train_digest(wildcards):
    code = config_baselines.TRAINING[model_of(wildcards)]
    return code_digest(code, stage="stages.baselines.train")


def feature_weights(wildcards):
    """Whether a loss of features can be computed, so that weights that come later are used."""
    method = BENCHMARK.methods[wildcards.method]
    if wildcards.method not in BENCHMARK.pictured:
        return "none"
    chosen = benchmarks.model_of(CONFIG, method, wildcards.method)
    return "absent" if isinstance(vgg16_weights.find(chosen.vgg16), str) else "found"


def predict_digest(wildcards):
    model = model_of(wildcards)
    kind = (
        "neuspring.baselines.untrained"
        if model in settings.UNTRAINED
        else f"neuspring.baselines.{model}.predict"
    )
    return code_digest(kind, "neuspring.scores.metrics", stage="stages.baselines.predict")


def train_records(wildcards):
    """The record of the training, for models that have one."""
    if not BENCHMARK.methods[wildcards.method].trained:
        return []
    return [
        f"{RESULTS}/{wildcards.scenario}/{wildcards.method}/{wildcards.seed}/train.json"
    ]


def own_capture(wildcards):
    """The capture, for methods that are trained on pictures."""
    return [capture_file(wildcards)] if wildcards.method in BENCHMARK.pictured else []


def own_masks(wildcards):
    if wildcards.method not in BENCHMARK.pictured:
        return []
    return camera_files(wildcards, "masks.json")


def own_splats(wildcards):
    """The record of the splats that a method's model itself moves."""
    if wildcards.method not in BENCHMARK.pictured:
        return []
    return appearance_records(wildcards)


def given(input, **options):
    """Command-line options for those inputs that there are."""
    words = []
    for name in options:
        files = input.get(name)
        if files:
            files = [files] if isinstance(files, str) else list(files)
            words += [options[name], *map(str, files)]
    return words


def train_options(wildcards, input):
    return given(input, capture="--capture", masks="--masks", appearance="--appearance")


def predict_options(wildcards, input):
    return given(input, train="--train", appearance="--appearance")


def stage_options(wildcards, input):
    """The records of the stages that a method has."""
    return given(input, search="--search", fit="--fit", train="--train")
