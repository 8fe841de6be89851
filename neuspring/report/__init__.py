"""Tables, the report page, and studies next to the paper's numbers.

- `tables`, `study`: tables of scores (`neuspring.scores.table`), written to summary.md and `studies/`.
- `blocks`: the parts of a page, as HTML and Markdown. `page` with its `sections`: report.html.
- `notes`: findings of finished runs. `perception`: errors of perception on synthetic captures.
- `shown`: the content of a results folder, for `play`, exports and figures.
"""
