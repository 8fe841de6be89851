"""Which pictures belong together: time stamps, else numbers in names, else the order; what could be wrong in silence is refused."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from neuspring.core.errors import InputError
from neuspring.extensions.make_capture.film import looked_at
from neuspring.extensions.make_capture.formats import open_images, pairs
from neuspring.extensions.make_capture.formats.folder import ImageFolder
from neuspring.extensions.make_capture.formats.video import VideoFile
from neuspring.extensions.make_capture.moments import Evenness, Series, matched, spans
from neuspring.extensions.make_capture.poses import choose

FILM = list(range(45))


def named(root, name, numbers, form="{:05d}.png"):
    """A folder of files with these numbers; only names are read."""
    folder = root / name
    folder.mkdir(parents=True)
    for number in numbers:
        (folder / form.format(number)).touch()
    return folder


def without(*lost):
    return [number for number in FILM if number not in lost]


def said(views, choice):
    return [str(one) for one in looked_at(views, choice)]


def test_cameras_that_each_lost_another_frame_are_paired_by_the_numbers_in_the_names(tmp_path):
    lost = (10, 30, 20)
    folders = [named(tmp_path, f"{kind}{k}", without(lost[k])) for kind in ("color", "depth") for k in range(3)]
    views = pairs(folders[:3], folders[3:])
    choice = choose(views)
    assert choice.numbers == FILM and choice.step == 1 and choice.jumps == []
    for view, gone in zip(views, lost, strict=True):
        assert choice.missing(view.name) == (gone,)
        for frame, place in choice.places[view.name].items():
            assert [path.stem for path in view.files([place])] == [f"{frame:05d}"] * 2
    assert [line.split("warning: ")[1].split(": ", 1)[1] for line in said(views, choice)] == [
        f"missing frames: camera {k} lacks {gone}; other cameras have them" for k, gone in enumerate(lost)
    ]


def test_images_that_lack_their_partner_are_named(tmp_path):
    views = pairs([named(tmp_path, "color", without(3, 40))], [named(tmp_path, "depth", without(20, 21, 22))])
    choice = choose(views)
    assert choice.numbers == without(3, 20, 21, 22, 40)
    assert said(views, choice)[1].endswith("left out: color 20 to 22; depth 3, 40")
    assert "frame numbers are left out after 2, 19, 39" in said(views, choice)[0]


@pytest.mark.parametrize(
    ("color", "depth", "words"),
    [
        (range(45), range(40), "45 pictures with the numbers 0 to 44 and 40 pictures with the numbers 0 to 39, none missing"),
        (range(45), range(23), "none missing in between, as if one had 1.96 times the rate"),
        (range(100, 144), range(1, 41), "44 pictures with the numbers 100 to 143 and 40 pictures with the numbers 1 to 40, none"),
        (without(10), range(500, 544), "0 numbers are common"),
        (without(10), [500 + number for number in without(30)], "0 numbers are common"),
    ],
)  # fmt: skip
def test_counters_of_their_own_are_refused(tmp_path, color, depth, words):
    view = pairs([named(tmp_path, "color", color)], [named(tmp_path, "depth", depth)])[0]
    with pytest.raises(InputError, match="depth: camera 0: color and depth must show the same moments; received") as caught:
        view.series.numbers  # noqa: B018
    assert words in str(caught.value) and "If one only ended early, remove the last pictures of the other" in str(caught.value)


@pytest.mark.parametrize(
    ("color", "depth", "found"),
    [
        (range(45), range(0, 45, 2), [*range(0, 45, 2)]),  # half as often, by one counter
        (range(45), range(5, 45), [*range(5, 45)]),  # began later
        (range(45), range(3, 43), [*range(3, 43)]),  # and ended earlier: one counter, whose inner part one has
        (range(45), without(7)[:40], without(7)[:40]),  # a gap: numbers of frames, and an early end
        (range(45), range(1000, 1045), [*range(45)]),  # counters of their own that ran alike
        (without(4), [1000 + number for number in without(4)], without(4)),
    ],
)  # fmt: skip
def test_what_numbers_say_is_taken(tmp_path, color, depth, found):
    view = pairs([named(tmp_path, "color", color)], [named(tmp_path, "depth", depth)])[0]
    assert view.series.numbers == found


def test_the_number_need_not_stand_at_the_end_of_the_name(tmp_path):
    color = named(tmp_path, "color", without(10), "frame-{:06d}.color.png")
    depth = named(tmp_path, "depth", without(30), "frame-{:06d}.depth2.png")
    assert pairs([color], [depth])[0].series.numbers == without(10, 30)


def test_cameras_with_unequal_counts_without_gaps_are_refused(tmp_path):
    colors, depths = ([named(tmp_path, f"{kind}{k}", range(n)) for k, n in enumerate((90, 45))] for kind in "cd")
    with pytest.raises(InputError, match=r"c1: camera 0 and camera 1 must show the same moments; received 90 .* 45 .* 2\.00 times"):
        choose(pairs(colors, depths))


TIMES = 1305031102.175304 + np.arange(45) / 30


@pytest.mark.parametrize(
    ("write", "offset"),
    [
        (lambda t: f"{t:.6f}", 0.004),
        (lambda t: str(round(1e3 * t)), 0.004),
        (lambda t: f"d_{round(1e9 * t)}_raw", 0.012),
        (lambda t: str(round(1e6 * (t - 1305030681))), 0.0001),
    ],
)
def test_names_that_are_times_are_paired_by_the_nearest(tmp_path, write, offset):
    for kind, stamps in (("color", np.delete(TIMES, 10)), ("depth", np.delete(TIMES, 30) + offset)):
        named(tmp_path, kind, [write(t) for t in stamps], "{}.png")
    views = pairs([tmp_path / "color"], [tmp_path / "depth"])
    moments = [k for k in range(45) if k not in (10, 30)]
    for place, moment in enumerate(moments):
        color, depth = (path.stem for path in views[0].files([place]))
        assert (color, depth) == (write(TIMES[moment]), write(TIMES[moment] + offset))
    assert views[0].rate([0, 42]) == pytest.approx(30, rel=1e-3)
    lines = said(views, choose(views))
    assert any(f"color and depth: by time stamps, at most {1e3 * offset:.3g} ms apart" in line for line in lines)
    assert any("about 2 lost pictures (after 9, 28 of 43)" in line and "warning" in line for line in lines)


@pytest.mark.parametrize(("form", "step"), [("1681234567123_{}.png", 1), ("20260131_{:03d}.png", 3), ("{:010d}.png", 1)])
def test_digits_that_are_no_time_count(tmp_path, form, step):
    """The start of a session, a date, and a counter with ten digits."""
    folder = ImageFolder(named(tmp_path, "color", range(0, 45 * step, step), form), "color")
    assert folder.series.times is None and np.diff(folder.series.numbers).tolist() == [step] * 44


def test_sixty_hertz_beside_thirty_is_paired_by_time_stamps():
    fast, slow = Series([*range(90)], times=np.arange(90) / 60), Series([*range(45)], times=np.arange(45) / 30)
    assert matched("x", ("a", "b"), fast, slow)[0] == {2 * k: k for k in range(45)}
    cut = Series([*range(40)], times=np.arange(40) / 30)
    with pytest.raises(InputError, match="45 pictures at 30 Hz and 40 pictures at 30 Hz, none missing in between"):
        matched("x", ("a", "b"), slow, cut)
    later = Series([*range(45)], times=2.0 + np.arange(45) / 30, clock="wall")
    with pytest.raises(InputError, match="0 are within half a frame of each other"):
        matched("x", ("a", "b"), Series(slow.numbers, times=slow.times, clock="wall"), later)


def film(path, *tracks):
    """A lossless video with a track of color for each list of ms, and of depth for each of negative ones; picture k is k + 1."""
    with av.open(str(path), "w") as container:
        streams = []
        for moments in tracks:
            stored = "gray16le" if min(moments) < 0 else "bgr0"
            streams.append(container.add_stream("ffv1", rate=1000, width=16, height=16, pix_fmt=stored))
            streams[-1].time_base = streams[-1].codec_context.time_base = Fraction(1, 1000)
        for moments, stream in zip(tracks, streams, strict=True):
            for k, moment in enumerate(moments):
                shape, kind, form = ((16, 16), np.uint16, "gray16le") if min(moments) < 0 else ((16, 16, 3), np.uint8, "rgb24")
                frame = av.VideoFrame.from_ndarray(np.full(shape, k + 1, kind), format=form)
                frame.pts, frame.time_base = abs(moment), Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return path


def ms(rates):
    """ms of pictures with these frames per second from each to the next."""
    return np.round(1000 * np.concatenate([[0], np.cumsum(1 / np.array(rates))])).astype(int).tolist()


@pytest.mark.parametrize(
    ("rates", "words"),
    [
        ([30] * 22 + [24] * 22, ("intervals of 33 to 42 ms, up to 1.2 frames off an even clock", "--frames 0-22", "-vf fps=24")),
        ([30] * 22 + [15] * 22, ("intervals of 33 to 67 ms, up to 3.7 frames", "--frames 0-22", "-vf fps=15")),
        ([30] * 20 + [7.5] + [30] * 20, ("about 3 lost pictures (after 20 of 42), up to 1.3 frames off", "--frames 0-20")),
        (([30] * 8 + [15]) * 5, ("about 5 lost pictures (after", "1 lost picture in 20 are allowed")),
    ],
)
def test_a_rate_that_varies_is_refused_with_the_next_move(tmp_path, rates, words):
    views = pairs([film(tmp_path / "a.mkv", ms(rates))], [])
    found = next(one for one in looked_at(views, choose(views)) if one.level == "error")
    assert found.name == "uneven time" and "at most 1 frame and" in found.text
    for word in words:
        assert word in found.text
    part = choose(views, found.text.split("--frames ")[1].split(",")[0])
    assert not [line for line in said(views, part) if "uneven" in line]
    assert views[0].rate([*part.places["0"].values()]) == pytest.approx(30, rel=0.01)


def test_an_even_rate_passes_without_a_word_and_a_small_unevenness_is_said():
    rough = np.random.default_rng(0).uniform(-1, 1, 300)
    even = Evenness.of(np.round(np.arange(300) / 29.97, 3), range(300))
    assert not even.bad and not even.odd
    jitter = Evenness.of((np.arange(300) + 0.2 * rough) / 30, range(300))
    assert jitter.odd and not jitter.bad
    lost = Evenness.of(np.delete(np.arange(300) / 30, 100), range(299))
    words = "intervals of 33 to 67 ms, about 1 lost pictures (after 99 of 299), up to 0.5 frames off an even clock"
    assert not lost.bad and lost.text() == words
    every_second = Evenness.of(np.arange(0, 300, 2) / 30, range(0, 300, 2))
    assert not every_second.odd and every_second.steps[0] == pytest.approx(1 / 30)


def test_a_film_that_was_trimmed_without_encoding_has_the_pictures_that_it_shows(tmp_path):
    """Its edit list hides 12 of 20 pictures, which lie in the file because the others need them."""
    with av.open(str(tmp_path / "whole.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=30, width=32, height=32, pix_fmt="yuv420p", options={"g": "60"})
        for k in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((32, 32, 3), 12 * k, np.uint8), format="rgb24")))
        container.mux(stream.encode())
    trimmed = tmp_path / "trimmed.mp4"
    options = {"avoid_negative_ts": "disabled"}
    with av.open(str(tmp_path / "whole.mp4")) as source, av.open(str(trimmed), "w", options=options) as container:
        copied = container.add_stream_from_template(source.streams.video[0])
        shift = int(Fraction(12, 30) / source.streams.video[0].time_base)
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, copied
                container.mux(packet)
    clip = VideoFile(trimmed, "color")
    assert clip.series.numbers == [*range(8)]
    assert [round(image.mean() / 12) for image in clip.read(range(8))] == [*range(12, 20)]


def test_of_several_tracks_the_first_is_read_and_said_or_the_one_that_is_named(tmp_path):
    path = film(tmp_path / "a.mkv", ms([30] * 9), ms([10] * 5))
    views = pairs([path], [])
    assert f"the first is read as color: {path}#0 is ffv1 16 x 16 bgr0; {path}#1 is ffv1" in said(views, choose(views))[0]
    views = pairs([tmp_path / "a.mkv#1"], [])
    assert said(views, choose(views)) == []
    assert len(views[0].series.numbers) == 6 and views[0].rate([0, 5]) == pytest.approx(10)
    assert next(open_images(tmp_path / "a.mkv#1", "color").read([3])).mean() == 4
    with pytest.raises(InputError, match="a video track is required; the file has 2, from 0; received track 2"):
        open_images(tmp_path / "a.mkv#2", "color").series  # noqa: B018
    with pytest.raises(InputError, match=r"received bgr0\. It has 2 video tracks: name that of depth, like .*a\.mkv#1"):
        open_images(path, "depth").series  # noqa: B018


def test_tracks_of_one_file_have_one_clock(tmp_path):
    """Depth began two pictures after color: its first belongs to the third of color."""
    moments = ms([30] * 11)
    film(tmp_path / "a.mkv", moments, [-moment for moment in moments[2:]])
    view = pairs([tmp_path / "a.mkv#0"], [tmp_path / "a.mkv#1"])[0]
    assert view.series.numbers == [*range(2, 12)] and view.alone == {"color": [0, 1], "depth": []}
    color, depth = next(view.read([0]))
    assert (color.mean(), depth.mean()) == (3, 1)


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_an_image_that_exif_data_turn_is_refused_in_a_folder(tmp_path, ending):
    exif, picture = Image.Exif(), Image.fromarray(np.zeros((4, 6, 3), np.uint8))
    exif[0x0112] = 1
    picture.save(tmp_path / f"0.{ending}", exif=exif)
    cv2.imwrite(str(tmp_path / f"1.{ending}"), np.zeros((4, 6, 3), np.uint8))
    assert [image.shape for image in ImageFolder(tmp_path, "color").read([0, 1])] == [(4, 6, 3)] * 2
    exif[0x0112] = 6
    picture.save(tmp_path / f"2.{ending}", exif=exif)
    with pytest.raises(InputError, match=r"upright, with EXIF orientation 1; received 6\. .*mogrify -auto-orient .*exiftool"):
        list(ImageFolder(tmp_path, "color").read([2]))


def test_numbers_in_few_words():
    assert spans([6, 13, 20, 21, 22]) == "6, 13, 20 to 22"
    assert spans(range(0, 40, 2)) == "0, 2, 4, 6, 8, 10 and 14 more"
