"""Stage `track`: masks of one camera -> tracks of pixels."""

from __future__ import annotations

from neuspring.config import Config
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import Capture
from neuspring.perception.backends import BACKENDS, backend_modules
from neuspring.stages.stage import Written, stage


@stage(
    output="{scenario}/perception/{camera}/tracks.json",
    rule="perceive",
    when=lambda rows: rows.source.films,
    reads=("perception.track",),
    code=lambda settings, given: backend_modules("track", settings.perception.track.backend),
    gpu=lambda settings: BACKENDS["track"][settings.perception.track.backend].gpu,
    memory_mb=8000,
    minutes=120,
)
def track(capture: Capture, camera: str, masks: Before, settings: Config, run: Recorder, device: str = "auto") -> Written:
    """Masks of one camera -> tracks of pixels: tracks.npz and tracks.png."""
    from neuspring.checks.perceived import look_at_tracks
    from neuspring.core.findings import findings_as_facts
    from neuspring.data.results import Masks, PixelTracks
    from neuspring.perception import figures

    section = settings.perception.track
    capture.require_camera(camera)
    labels = Masks.load(masks.file("masks")).labels
    followed = BACKENDS["track"][section.backend].track(capture, camera, labels, settings.perception, device)
    if not (count := followed.pixels.shape[1]):
        print(f"camera {camera}: neither object nor hands are visible in frame 0; this camera is not used", flush=True)
    facts = {"points": float(count), "visible_share": float(followed.visible.mean()) if count else 0.0}
    tracks = PixelTracks(pixels=followed.pixels, visible=followed.visible, backend=section.backend, facts=facts)
    files = run.beside(tracks="tracks.npz", picture="tracks.png")
    tracks.save(files["tracks"])
    figures.tracks_strip(capture, camera, tracks, files["picture"])
    findings = look_at_tracks(capture, camera, labels, tracks.pixels, tracks.visible)
    return Written(files=files, facts=tracks.facts | findings_as_facts(findings))
