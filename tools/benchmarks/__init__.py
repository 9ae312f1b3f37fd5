"""The rows of `tools/bench.py`: one module per kind of comparison."""
