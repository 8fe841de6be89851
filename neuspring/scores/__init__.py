"""Numbers: metrics of points and pictures, statistics, the paper's values, conformance with the release."""
