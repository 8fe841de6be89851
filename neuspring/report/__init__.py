"""Tables, figures and pages for people.

- `blocks`: what pages are made of, as HTML and as Markdown.
- `grid`, `summary`, `study`, `clips`, `verdict`, `notes`, `perception`: numbers laid out, once for files and for the page.
- `page` with its `sections`: report.html and pictures.html.
- `draw`, `video`: pictures of runs and for papers, H.264 videos.
- `explain`: from a cell of a table to its runs.
"""
