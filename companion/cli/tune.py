"""STUDY gives the flight, its vehicle and the disturbances (docs/campaigns.md). Only gains that pass the certificate
and leave the delay margin that is asked for are flown; all fly the same flights. The choice is explained, and compared
with the gains of before in flights that the search has not seen. Exit code 3: no gains are allowed, or no flight
converges with the best.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.common import EngineOption, JsonOption, VehicleOption, say

if TYPE_CHECKING:
    from companion.campaign.study import Study
    from companion.campaign.tune import Tuned

EXAMPLE = "Example: companion tune robustness --vehicle bundled --out gains.toml"


def run(
    study: Annotated[str, typer.Argument(help="Study file, or the name of a bundled one.")] = "robustness",
    vehicle: VehicleOption = None,
    margin_ms: Annotated[
        float, typer.Option("--margin", metavar="MS", min=10.0, max=200.0, help="Least delay margin.")
    ] = 20.0,
    flights: Annotated[int, typer.Option("--flights", min=2, max=500, help="Flights of every candidate.")] = 12,
    generations: Annotated[int, typer.Option("--generations", min=1, max=500, help="Of the search.")] = 12,
    weight: Annotated[
        float, typer.Option("--actuation", metavar="X", min=0.0, max=10.0, help="How much actuation counts; error: 1.")
    ] = 0.3,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes; default one per core.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write [controller] for a vehicle or flight file.")
    ] = None,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Searches gains for a vehicle and a set of disturbances."""
    from rich.console import Console
    from rich.progress import Progress

    from companion import accelerate
    from companion.campaign import tune as search
    from companion.campaign.study import load_study
    from companion.errors import InputError

    if out is not None and (out.is_dir() or not out.absolute().parent.is_dir()):  # the search takes minutes
        raise InputError(f"--out {out}: cannot be written: it is a folder, or in one that is not there")
    chosen = accelerate.resolve(engine)
    found = load_study(study, vehicle=vehicle)
    wish = search.Wish(margin_ms * 1e-3, flights, weight)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("searching", total=generations)

        def progress(count: int, best: search.Score) -> None:
            flown = f"{best.rms_m * 100:.2f} cm rms" if best.converged else "no flight converges"
            state = best.unfit[:40] or flown
            bar.update(task, advance=1, description=f"{count} gain sets, best {state}")

        tuned = search.tune(found, wish, chosen, generations=generations, workers=workers, progress=progress)
    sentences = search.words(tuned, wish)
    if as_json:
        document = {
            "vehicle": found.flight.vehicle.name,
            "study": found.name,
            "output": tuned.output,
            "gains": tuned.gains,
            "before": tuned.before,
            "gain_sets": tuned.evaluations,
            "search": tuned.search._asdict(),
            "fresh": tuned.fresh._asdict(),
            "fresh_before": tuned.fresh_before._asdict(),
            "words": sentences,
        }
        print(json.dumps(_finite(document), indent=2))
    else:
        _say(found, tuned, sentences)
    if out is not None:  # what was found is told already, if this fails
        _write(out, tuned.gains, sentences)
        say(f"wrote {out}", quiet=as_json)


def _say(found: Study, tuned: Tuned, sentences: list[str]) -> None:
    say(f"{found.flight.vehicle.name} in {found.name}: the best of {tuned.evaluations} gain sets")
    for name, value in tuned.gains.items():
        say(f"  {name:24s} {value:<8g} (before {tuned.before[name]:g})")
    for sentence in sentences:
        say(f"- {sentence}")


def _write(path: Path, gains: dict[str, float], sentences: list[str]) -> None:
    from companion.errors import InputError

    lines = [*(f"# {sentence}" for sentence in sentences), "[controller]"]
    lines += [f"{name} = {value!r}" for name, value in gains.items()]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written: {error.strerror}") from None


def _finite(value: object) -> object:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, float) and value != value:  # noqa: PLR0124
        return None
    return value
