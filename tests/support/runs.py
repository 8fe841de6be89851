"""Records of runs that were not executed."""

from neuspring.core.run_record import RunRecord

STARTED, ENDED = "2026-11-21T10:00:00+00:00", "2026-11-21T10:05:00+00:00"


def run_record(**changes):
    """A record with plausible facts; `changes` replace them."""
    facts = {
        "run_key": "0" * 64,
        "scenario": "rope",
        "source": "toy",
        "category": "rope",
        "method": "ours",
        "variant": {},
        "seed": 0,
        "status": "ok",
        "reason": "",
        "data_digest": "0" * 64,
        "attempt": 1,
        "commit": "0123456789abcdef",
        "device": "cpu",
        "machine": "x86_64, Python 3.11",
        "started": STARTED,
        "ended": ENDED,
        "params": {},
        "timings": {},
        "scores_file": "scores.parquet",
    }
    return RunRecord(**(facts | changes))
