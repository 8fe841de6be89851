"""One run at a time works in a results folder."""

import subprocess
import sys

import pytest

from neuspring.core.errors import InputError
from neuspring.experiments.claim import claim

HOLD = """
import sys, time
from pathlib import Path
from neuspring.experiments.claim import claim
claim(Path(sys.argv[1]), "a")
print(flush=True)
time.sleep(99)
"""


@pytest.mark.parametrize(("settings", "words"), [("a", "with the same settings"), ("b", "with other settings")])
def test_a_second_run_is_refused_until_the_first_has_ended_however_it_ends(tmp_path, settings, words):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        holder.stdout.readline()
        with pytest.raises(InputError, match=f"process {holder.pid} on .*{words}.*results=OTHER_FOLDER"):
            claim(tmp_path, settings)
    finally:
        holder.kill()
        holder.wait()
    claim(tmp_path, settings)
