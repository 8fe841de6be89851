"""What people look at.

- `table`: a table as one value; `blocks`: what pages are made of; both become Markdown and HTML.
- `benchmark`, `study_cells`, `study`, `notes`, `perception`: the tables, built once for files and for the page.
- `page`: report.html; `gallery`: pictures.html.
- `figures`, `paper`, `video`: PNG figures of runs, pictures for papers, H.264 videos.
- `explain`: from a cell of a table to its runs.
"""
