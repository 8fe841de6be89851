"""Tables of a benchmark (`summary`), of the paper's studies beside the paper's values (`cells`, `render`, `study`), of perception."""
