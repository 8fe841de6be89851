"""A twin in the formats of other tools. README.md here is the page for users.

| what | modules |
|---|---|
| what is exported: a run's folder or a twin | `source` |
| arrays and a JSON description | `plain` |
| viewers | `ply`, `usd` |
| simulators: Newton, MuJoCo | `simulators`; `newton_twin` is the script that is exported |
"""
