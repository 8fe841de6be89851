"""Times in names: every form that recorders write, and numbers that are none."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from neuspring.extensions.make_capture.stamps import times_of

BEGIN = datetime(2024, 5, 1, 12, 59, 59, 433000)


def names(write, rate=30.0, count=40):
    """Names of pictures, by a function of the moment and the s since the first."""
    return [write(BEGIN + timedelta(seconds=k / rate), k / rate) for k in range(count)]


def of(seconds, unit):
    return f"{round(seconds / unit)}"


@pytest.mark.parametrize(
    ("write", "clock"),
    [
        (lambda t, _: t.strftime("%Y%m%d_%H%M%S_") + f"{t.microsecond // 1000:03d}", "wall"),
        (lambda t, _: t.strftime("color-%Y-%m-%dT%H-%M-%S.%f"), "wall"),
        (lambda t, _: t.strftime("cam0_%Y%m%d%H%M%S") + f"{t.microsecond // 1000:03d}", "wall"),
        (lambda t, s: t.strftime("%Y%m%d_%H%M%S_") + f"{t.microsecond // 1000:03d}_{round(30 * s):04d}", "wall"),
        (lambda t, _: t.strftime("%H-%M-%S-%f"), "device"),
        (lambda t, _: t.strftime("%H%M%S_%f"), "device"),
        (lambda _, s: f"{1305031102.175304 + s:.6f}", "wall"),
        (lambda _, s: of(1681234567.123 + s, 1e-3), "wall"),
        (lambda _, s: of(1681234567.123 + s, 1e-9), "wall"),
        (lambda _, s: f"rgb_{12.0 + s:.6f}", "device"),
        (lambda _, s: str(round(9.9 + s, 3)), "device"),
        (lambda _, s: of(421.733366 + s, 1e-6), "device"),
        (lambda _, s: f"{int(421.9 + s)}_{round((421.9 + s) % 1 * 1e9) % 10**9:09d}", "device"),
        (lambda _, s: f"{int(421.9 + s)}-{int((421.9 + s) % 1 * 1e9)}", "device"),
        (lambda _, s: f"frame_{round(30 * s):06d}_{of(1714566615.033 + s, 1e-3)}", "wall"),
        (lambda _, s: f"20240501_{round(30 * s):06d}_{of(1714566615.033 + s, 1e-3)}", "wall"),
        (lambda _, s: f"{round(30 * s):06d}_{1714566615.033 + s:.3f}", "wall"),
        (lambda t, s: t.strftime("%H-%M-%S-") + f"{int(30 * (s + 0.433) + 1e-6) % 30:02d}", "device"),  # a time code
    ],
)
def test_a_time_in_any_form_is_read(write, clock):
    times, found = times_of(names(write))
    assert found == clock
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=0.0011)


@pytest.mark.parametrize(
    "write",
    [
        lambda _, s: f"{round(30 * s):05d}",
        lambda _, s: f"frame_{10 * round(30 * s)}",  # one in ten of a film
        lambda _, s: f"frame-{round(30 * s):06d}.color2",
        lambda _, s: f"{round(30 * s) // 10:03d}_{round(30 * s) % 10:03d}",
        lambda t, s: t.strftime("%Y%m%d_%H%M%S_") + f"{round(30 * s):04d}",
        lambda _, s: f"{round(30 * s):010d}",
        lambda _, s: f"{(7 * round(30 * s)) ** 2}",
        lambda _, s: f"{round(30 * s):05d}_031",
        lambda _, s: f"{round(30 * s):05d}_{31 + round(30 * s) % 3:03d}",  # a counter and an exposure
        lambda _, s: f"12-30-15-{round(30 * s):02d}",
    ],
)
def test_what_counts_pictures_is_no_time(write):
    assert times_of(names(write)) is None


@pytest.mark.parametrize("separator", ["-", "_", "."])
def test_hundredths_of_seconds_are_a_time(separator):
    times, clock = times_of(names(lambda t, _: f"{t:%H-%M-%S}{separator}{t.microsecond // 10000:02d}"))
    assert clock == "device"
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=0.0101)


def test_lost_pictures_and_jitter_leave_a_time_one():
    rough = np.random.default_rng(0).uniform(-20e-6, 20e-6, 40)
    times, clock = times_of([of(77.1 + k / 30 + rough[k], 1e-6) for k in range(40) if k not in (5, 6, 20)])
    assert clock == "device" and np.round(np.diff(times) * 30).max() == 3
