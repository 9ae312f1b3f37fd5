"""Small campaigns for tests: a study of seconds, in a file."""

import os

from companion.campaign.study import load_study

TINY = """
name = "tiny"
flight = "{flight}"
count = {count}
seed = 3
duration_s = {duration_s}

[vary.start]
north_m = {{ uniform = [1.0, 2.0] }}

[vary.vehicle]
mass_factor = {{ uniform = [0.95, 1.05] }}
"""


def tiny(folder, count=3, duration_s=0.5, more="", flight="eight"):
    """A study of `count` flights."""
    return load_study(str(tiny_file(folder, count, duration_s, more, flight)))


def tiny_file(folder, count=3, duration_s=0.5, more="", flight="eight"):
    path = folder / "tiny.toml"
    path.write_text(TINY.format(count=count, duration_s=duration_s, flight=flight) + more)
    return path


def die(*arguments):
    """What a worker does that runs out of memory."""
    os._exit(1)
