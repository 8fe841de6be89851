"""A twin in the formats of other tools. README.md here is the page for users.

| what | modules |
|---|---|
| what is exported: a run's folder or a twin | `source` |
| arrays and a JSON description | `plain`, `equations` |
| viewers | `ply`, `usd`, `spz` |
| simulators | `newton`, with `newton_twin` (the script that is exported); `mujoco` |
"""
