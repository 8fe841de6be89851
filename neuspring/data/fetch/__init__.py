"""`neuspring fetch`: released archives from the Hugging Face hub.

- `fetch`: the command: scenarios and parts, disk space, extraction, the record fetched.json.
- `archive`: which files of an archive belong to which part of which scenario; what is missing on disk.
- `hub`: the hub's list of files, and range reads of them.
"""

import os

# huggingface_hub reads this when it is first imported.
os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
