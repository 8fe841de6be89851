# What the rules of search, fit and rollout ask: their settings, and the records that they start from.
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


def search_records(wildcards):
    """The search's record; a baseline's model has none."""
    if BENCHMARK.methods[wildcards.method].model:
        return []
    return [search_record(wildcards)]


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


def learned_record(wildcards):
    """The record that names what is transferred: a twin, or the model of a baseline."""
    return (train_records(wildcards) or [twin_record(wildcards)])[0]


def transfer_digest(wildcards):
    """The code that moves a twin, or a network, to another recording."""
    own = (
        ["neuspring.baselines.gs_dynamics.predict"]
        if BENCHMARK.methods[wildcards.method].model
        else ["neuspring.twin.rollout", "neuspring.twin.transfer", "neuspring.twin.motion"]
    )
    return code_digest(*own, "neuspring.scores.metrics", stage="stages.stages.transfer")


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


def carry_option(wildcards):
    return "--carry-over" if BENCHMARK.methods[wildcards.method].carry_over else ""


def variant(wildcards):
    return variant_of(wildcards.method)


@functools.cache
def variant_of(name):
    """The switches of a method, for its record."""
    method = BENCHMARK.methods[name]
    row = settings.plain(method)
    if method.model:
        return json.dumps({"model": method.model, **row["settings"]}, sort_keys=True)
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
    """One per source, method and seed. Carrying over and averaging concern the same recording's future, not another one; Spring-Gaus
    was never transferred, and what has learned nothing has nothing to transfer."""
    methods = [
        name
        for name, method in BENCHMARK.methods.items()
        if (method.search or method.model == "gs_dynamics")
        and not (method.carry_over or method.average_seeds)
    ]
    return expand(
        "{results}/{scenario}/{method}/{seed}/transfer.json",
        results=RESULTS,
        scenario=BENCHMARK.transfers,
        method=methods,
        seed=CONFIG.seeds,
    )
