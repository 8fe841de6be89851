"""Processes that start together compile each kernel once."""

import os
import subprocess
import sys

LOAD = """
import logging, sys
import warp as wp
from neuspring.core import device as kernels
from neuspring.physics import collision, frame
wp.config.log_level = logging.INFO
sys.stdin.readline()
for kernel in (*collision.kernels(wp.float32, 1), frame.kernels(wp.float32, 1).begin):
    kernels.load(kernel, "cpu")
"""


def test_processes_that_start_together_compile_each_kernel_once(tmp_path):
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    start = [sys.executable, "-c", LOAD]
    crowd = [
        subprocess.Popen(start, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, text=True)
        for _ in range(4)
    ]
    outputs = [process.communicate("\n")[0] for process in crowd]
    assert all(process.returncode == 0 for process in crowd), outputs
    assert "".join(outputs).count("(compiled)") == 3
    assert "".join(outputs).count("(cached)") == 3 * 3
