"""The paper: topology, neural spring field, search, fit, prediction."""
