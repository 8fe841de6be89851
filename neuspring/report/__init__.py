"""What people look at.

- `blocks`: what pages are made of, as HTML and as Markdown.
- `benchmark`, `study_cells`, `study`, `notes`, `perception`: the tables, built once for files and for the page.
- `page` with its `sections`: report.html and pictures.html.
- `draw`, `video`: pictures of runs and for papers, H.264 videos.
- `explain`: from a cell of a table to its runs.
"""
