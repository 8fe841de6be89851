"""Tables of a benchmark (`summary`), of studies beside the paper (`cells`, `render`, `study`), and of perception."""
