"""What people look at.

- `tables`: the summary of a benchmark, the paper's tables beside ours, perception against the truth.
- `page`: report.html; `gallery`: pictures.html; `blocks`, `render`: what pages are made of, and how they become HTML.
- `figures`, `video`: PNG figures and H.264 videos.
- `explain`, `explain_text`: from a cell of a table to its runs.
"""
