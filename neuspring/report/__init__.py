"""Tables, the report page, and studies beside the paper's numbers.

- `tables`, `study`: queries on the long table (`neuspring.scores.table`), laid out; summary.md and studies.
- `blocks`: the parts of a page, as HTML and Markdown. `page` with its `sections`: report.html.
- `notes`: findings of finished runs. `perception`: errors of perception against the truth.
- `shown`: what a results folder holds, for `play`, exports and figures.
"""
