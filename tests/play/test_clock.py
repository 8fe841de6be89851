"""Time of a recording: it runs at the recorded rate, starts again or stops at the end, and knows its part."""

import pytest

from neuspring.play.clock import Clock


def clock(**changes) -> Clock:
    return Clock(count=10, rate=20.0, border=7, playing=True, **changes)


def test_time_runs_at_the_recorded_rate_times_the_speed():
    one = clock(speed=0.5)
    assert not one.advance(0.05) and one.advance(0.05)
    assert one.frame == 1


def test_it_starts_again_or_stops_at_the_end():
    one, other = clock(), clock(loop=False)
    one.advance(0.55), other.advance(0.55)
    assert (one.frame, one.playing) == (1, True)
    assert (other.frame, other.playing) == (9, False)


@pytest.mark.parametrize(("frame", "part"), [(0, "training"), (6, "training"), (7, "future"), (99, "future"), (-5, "training")])
def test_the_border_is_shown(frame, part):
    one = clock()
    one.show(frame)
    assert one.part == part and f"{part} frame {one.frame} of 9" in one.bar()
