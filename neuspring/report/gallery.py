"""A page that shows what methods predict: the videos of every scenario side by side, with their scores. Offline, no scripts.

Videos and pictures are referenced where they lie, so the page works wherever the results folder is.
"""

from __future__ import annotations

import html
import os
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, read_json

NAME = "pictures.html"
STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.5rem auto; max-width: 110rem; padding: 0 1rem; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid #8886; }
.methods { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 34rem), 1fr)); gap: 1.2rem; }
figure { margin: 0; }
figcaption { margin-bottom: .3rem; }
video, img { width: 100%; height: auto; background: #000; }
video.turn { width: 50%; }
details { margin: .6rem 0; }
""".strip()


def write(results: Path, scenarios: Iterable[str], methods: Iterable[str], seed: int, scores: pd.DataFrame, folder: Path) -> Path:
    """Write pictures.html into `folder`: every method of every scenario, for one seed. Runs that are missing are left out."""
    sections = []
    for scenario in scenarios:
        place = Path(results) / scenario
        shown = [_figure(place / method / str(seed), scenario, method, seed, scores, folder) for method in methods]
        # Those of all methods, then those of methods with splats of their own.
        learned = sorted(place.glob(f"appearance*/{seed}/appearance.png"))
        body = "<p>No pictures: no images, or no finished run.</p>"
        if any(shown):
            splats = "".join(_image(path, folder) for path in learned)
            body = f'<details><summary>Splats of frame 0</summary>{splats}</details><div class="methods">{"".join(shown)}</div>'
        sections.append(f"<h2>{html.escape(scenario)}</h2>\n{body}\n")
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>NeuSpring: pictures</title>'
    about = (
        "Observed, predicted and their difference, first camera; below, the twin from all around. The bar above each video shows "
        f"the time: blue is for training, orange is the future. Seed {seed}."
    )
    page = f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body><h1>Pictures</h1><p>{about}</p>\n'
    path = folder / NAME
    write_text(path, page + "".join(sections) + "</body></html>\n")
    return path


def _figure(run: Path, scenario: str, method: str, seed: int, scores: pd.DataFrame, folder: Path) -> str:
    """One run's videos (or its strip, without videos) and scores; empty if it has no pictures."""
    if not (run / "run.json").is_file():
        return ""
    named = read_json(run / "run.json", RECORD_FORMAT)["artifacts"].get("images", [])
    paths = {path.stem: path for path in (run / name for name in named) if path.is_file()}
    if "video" in paths:
        videos = [_video(paths["video"], folder, ""), _video(paths["turntable"], folder, "turn")]
        pictures = "".join(videos)
    elif "images" in paths:
        pictures = _image(paths["images"], folder)
    else:
        return ""
    own = scores[(scores["scenario"] == scenario) & (scores["method"] == method) & (scores["seed"] == seed)]
    means = own.set_index(["task", "metric"])["value"]
    parts = [
        f"{name} {means[task, 'psnr']:.1f} dB, IoU {means[task, 'iou']:.2f}"
        for task, name in (("reconstruction", "training"), ("future", "future"))
        if (task, "psnr") in means.index
    ]
    caption = f"<b>{html.escape(method)}</b> {html.escape('; '.join(parts))}"
    return f"<figure><figcaption>{caption}</figcaption>{pictures}</figure>\n"


def _video(path: Path, folder: Path, kind: str) -> str:
    return f'<video class="{kind}" src="{_link(path, folder)}" autoplay controls loop muted playsinline></video>'


def _image(path: Path, folder: Path) -> str:
    return f'<img src="{_link(path, folder)}" alt="{html.escape(path.stem)}" loading="lazy">'


def _link(path: Path, folder: Path) -> str:
    return html.escape(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix(), quote=True)
