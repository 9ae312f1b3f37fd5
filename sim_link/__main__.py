"""`python -m sim_link` is `sim-link`."""

from .cli import main

main()
