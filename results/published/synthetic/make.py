"""First, middle and last frame of every capture in a results folder, with its size and accuracy.

python -m results.published.synthetic.make results/synthetic results/published/synthetic
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from neuspring.data.capture import CAPTURE, Capture
from neuspring.extensions.synthetic.truth import Truth, truth_path

SIZE = (212, 120)
LABEL = 14
COLUMNS = 2


def strip(capture: Capture) -> np.ndarray:
    """Three frames of the first camera side by side, below the name of the scene."""
    camera = next(iter(capture.cameras))
    frames = [0, capture.frame_count // 2, capture.frame_count - 1]
    images = [cv2.resize(capture.color(camera, frame), SIZE, interpolation=cv2.INTER_AREA) for frame in frames]
    head = np.full((LABEL, 3 * SIZE[0], 3), 255, np.uint8)
    name = f"{capture.description.name.removeprefix('synthetic_')} ({capture.frame_count} frames)"
    cv2.putText(head, name, (4, LABEL - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (30, 30, 30), 1, cv2.LINE_AA)
    return np.vstack([head, np.hstack(images)])


def facts(capture: Capture) -> dict[str, object]:
    """Size and numerical accuracy of a capture, from its files."""
    folder = capture.folder.parent
    truth = Truth.load(truth_path(capture.folder))
    size = sum(path.stat().st_size for path in capture.folder.rglob("*") if path.is_file())
    return {
        "scenario": folder.name,
        "category": capture.description.category,
        "frames": capture.frame_count,
        "nodes": truth.nodes.shape[1],
        "substeps": truth.substeps,
        "certificate_mm": round(1e3 * truth.certificate, 4),
        "sensitivity_mm": round(1e3 * truth.sensitivity, 4),
        "least_jacobian": round(float(truth.least_jacobian.min()), 3),
        "megabytes": round(size / 1e6, 1),
    }


def main() -> None:
    """Write contact_sheet.jpg and captures.csv."""
    results, output = map(Path, sys.argv[1:])
    captures = [Capture.load(path.parent) for path in sorted(results.glob(f"*/capture/{CAPTURE}"))]
    strips = [strip(capture) for capture in captures]
    blank = np.full_like(strips[0], 255)
    rows = [np.hstack((strips[k : k + COLUMNS] + [blank] * COLUMNS)[:COLUMNS]) for k in range(0, len(strips), COLUMNS)]
    output.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(output / "contact_sheet.jpg"), np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    table = pd.DataFrame([facts(capture) for capture in captures])
    table.to_csv(output / "captures.csv", index=False)
    print(table.to_string(index=False))
    print(f"{len(table)} captures, {table['megabytes'].sum():.0f} MB")


if __name__ == "__main__":
    main()
