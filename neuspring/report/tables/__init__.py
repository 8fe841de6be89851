"""Tables of a benchmark, and of the paper's studies beside the paper's values."""
