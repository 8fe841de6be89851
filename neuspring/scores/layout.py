"""How tables name, scale and set out what they hold."""

from __future__ import annotations

from collections.abc import Mapping

MM = 1e3
HEADINGS = {
    ("reconstruction", "chamfer"): "Recon. CD",
    ("reconstruction", "track_error"): "Recon. TE",
    ("future", "chamfer"): "Future CD",
    ("future", "track_error"): "Future TE",
}
IMAGE_HEADINGS = {
    (task, metric): f"{short} {label}"
    for task, short in (("reconstruction", "Recon."), ("future", "Future"))
    for metric, label in (("psnr", "PSNR"), ("ssim", "SSIM"), ("lpips", "LPIPS"), ("iou", "IoU"))
}
TRANSFER_HEADINGS = {("transfer", "chamfer"): "Transfer CD", ("transfer", "track_error"): "Transfer TE"}
Headings = Mapping[tuple[str, str], str]
SHOWN = {"chamfer": (MM, 2), "track_error": (MM, 2), "psnr": (1.0, 2), "ssim": (1.0, 4), "lpips": (1.0, 4), "iou": (1.0, 3)}
"""Metric -> factor and digits in tables."""


def markdown(header: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a table whose columns are as wide as their widest cell."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]

    def line(cells: list[str]) -> str:
        return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"

    return [line(header), "|" + "|".join("-" * (width + 2) for width in widths) + "|", *map(line, rows)]
