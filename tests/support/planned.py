"""Plans of tiny benchmarks, and records of jobs that were not run."""

from collections import Counter

from neuspring.cli.main import COMMANDS
from neuspring.core.job_records import JobRecord
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph
from neuspring.experiments.tasks import Tasks
from tests.support.project import ROOT, config_with


def planned(results="results", **changes):
    """The jobs of the tiny configuration with changes."""
    graph = Graph(Benchmark(config_with({"results": str(results)} | changes), ROOT))
    Tasks(graph, COMMANDS)
    return graph


def targets(graph):
    """The units of the target `all`."""
    return [graph.unit("page", "all"), *graph.runs()]


def counted(units):
    """Jobs by rule."""
    return dict(Counter(unit.rule for unit in units))


def finish(graph, units):
    """Write records as if jobs had run."""
    for unit in units:
        for one in (*unit.members, unit):
            made = {step: dict(values) for step, values in one.made_of.items()}
            JobRecord(rule=one.rule, name=f"{one.rule}/{one.name}", made_of=made).save(graph.record(one))
