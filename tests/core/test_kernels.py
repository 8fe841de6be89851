"""Processes that start together compile each kernel once."""

import os
import re
import subprocess
import sys
from collections import Counter

import pytest

LOAD = """
import logging, sys
import torch
import warp as wp
from tests.support.scenes import scene, solver_for
solver = solver_for(scene(2, self_collision=True), 0)
wp.config.log_level = logging.INFO
points, nobody = torch.eye(3, dtype=torch.float64)[:2], torch.zeros(0, 3, dtype=torch.float64)
print("ready", flush=True)
sys.stdin.readline()
solver.backward(*solver.forward(points, points, nobody, nobody))
"""


@pytest.mark.slow
def test_processes_that_start_together_compile_each_kernel_once(tmp_path):
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    start = [sys.executable, "-c", LOAD]
    crowd = [
        subprocess.Popen(start, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, text=True)
        for _ in range(2)
    ]
    for process in crowd:
        assert process.stdout is not None
        # Warp may say something before.
        while line := process.stdout.readline():
            if line == "ready\n":
                break
    for process in crowd:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    outputs = [process.communicate()[0] for process in crowd]
    assert all(process.returncode == 0 for process in crowd), outputs
    # Four that list partners, and a frame forward and backward.
    loads = Counter(re.findall(r"Module (\S+) .*\((compiled|cached)\)", "".join(outputs)))
    kernels = {kernel for kernel, _ in loads}
    assert len(kernels) == 6
    assert loads == {(kernel, way): 1 for kernel in kernels for way in ("compiled", "cached")}
