"""The control law of the paper: pure functions over numbers, importing nothing else of the project."""
