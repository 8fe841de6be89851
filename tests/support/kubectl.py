"""A stand-in for kubectl: Jobs are files in a folder, pods are processes of this machine. It knows what pods.py asks of it.

A Job whose number is in the file `evicted` fails without having run.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

FOLDER = Path(os.environ["KUBECTL_FOLDER"])


def create():
    manifest = json.load(sys.stdin)
    number = len(list(FOLDER.glob("*.json")))
    name = f"{manifest['metadata']['generateName']}{number}"
    (FOLDER / f"{number}-{name}.json").write_text(json.dumps(manifest))
    ended = FOLDER / f"{name}.exit"
    if str(number) in (FOLDER / "evicted").read_text().split():
        ended.write_text("137")
    else:
        [container] = manifest["spec"]["template"]["spec"]["containers"]
        # A pod knows nothing of the environment that Snakemake runs in, but what the image sets.
        image = {name: os.environ[name] for name in ("PATH", "HOME", "PYTHONPATH")}
        with (FOLDER / f"{name}.log").open("w") as log:
            subprocess.Popen(
                ["/bin/sh", "-c", '"$@"; echo $? > "$0.new"; mv "$0.new" "$0"', str(ended), *container["command"]],
                cwd="/",
                env=image,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
    print(f"job.batch/{name}")


def get(name):
    ended = FOLDER / f"{name}.exit"
    if not ended.exists():
        print(json.dumps({"status": {"active": 1}}))
        return
    condition = "Complete" if ended.read_text().strip() == "0" else "Failed"
    print(json.dumps({"status": {"conditions": [{"type": condition, "status": "True"}]}}))


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["create", "-f", "-", "-o", "name"]:
            create()
        case ["get", "job", job, "-o", "json"]:
            get(job)
        case _:
            raise SystemExit(f"not known: {sys.argv}")
