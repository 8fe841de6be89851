"""What a machine with a GPU is asked for, by one command: `python -m tests.gpu`. See tests/benchmarks/GPU.md."""
