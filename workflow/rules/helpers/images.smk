# What the rules of splats and pictures ask: settings, records, options.
def image_settings(*names):
    """Some keys of `images`, so that changing another one runs nothing again."""
    values = settings.plain(CONFIG)["images"]
    return json.dumps(
        {"images": {name: values[name] for name in names}}, sort_keys=True
    )


def appearance_settings(wildcards):
    """What trains splats; of processed data, which perception has not lifted, also how masks are lifted."""
    chosen = json.loads(image_settings("backend"))
    chosen["images"]["appearance"] = settings.plain(looks_of(wildcards.looks))
    quirks = settings.plain(CONFIG)["images"]["released_quirks"]
    chosen["images"]["released_quirks"] = {"corner_pixels": quirks["corner_pixels"]}
    if BENCHMARK.scenarios[wildcards.scenario].source not in settings.FILMED:
        chosen |= json.loads(perception_settings("lift"))
    return json.dumps(chosen, sort_keys=True)


SHARED_LOOKS = "appearance"
LOOKS = "|".join(
    [SHARED_LOOKS, *(f"{SHARED_LOOKS}-{re.escape(name)}" for name in BENCHMARK.splats)]
)


def looks_of(folder):
    """How the splats of a folder are trained: those of all methods, or a method's own."""
    name = folder.removeprefix(f"{SHARED_LOOKS}-")
    if name == SHARED_LOOKS:
        return CONFIG.images.appearance
    return benchmarks.appearance_of(CONFIG, BENCHMARK.splats[name], name)


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
    owner = BENCHMARK.splats_of_method.get(wildcards.method)
    looks = f"{SHARED_LOOKS}-{owner}" if owner else SHARED_LOOKS
    return [f"{RESULTS}/{wildcards.scenario}/{looks}/{wildcards.seed}/appearance.json"]


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
