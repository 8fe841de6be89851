"""A plugin of pytest that adds a metric of positions and one of pictures to ours: `pytest -p tests.support.one_metric_more`."""

import numpy as np

from neuspring.scores.metrics import METRICS, Metric

EXTENT = Metric(
    name="extent",
    title="extent",
    heading="Extent",
    unit="m",
    shown_unit="cm",
    factor=100.0,
    digits=1,
    in_studies=True,
    function=lambda positions, _: np.ptp(positions[..., 2], axis=1),
)
GAP = Metric(
    name="gap",
    title="gap of colors",
    heading="Gap",
    unit="1",
    of="pictures",
    digits=3,
    function=lambda pair, _: float(np.abs(pair.observed.astype(float) - pair.rendered[..., :3]).mean()),
)
METRICS._own.update({metric.name: metric for metric in (EXTENT, GAP)})
