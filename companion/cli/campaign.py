"""STUDY is a study file or the name of a bundled one (region, robustness): what is varied, how, and how many flights.
They run without sockets on all cores; each has a seed of its own. Called again, an interrupted campaign goes on.

companion campaign replay [FOLDER] ID flies one flight of a campaign again, alone: in this process, and over MAVLink
against the bundled vehicle. Without FOLDER it is of the newest one in ./campaigns.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.common import EngineOption, JsonOption, say
from companion.errors import InputError

if TYPE_CHECKING:
    from companion.campaign.engines import Fleet
    from companion.campaign.run import Ran
    from companion.campaign.study import Study

EXAMPLE = """Again, flight 17 of a campaign: companion campaign replay campaigns/region 17. On a cluster of its own:
companion campaign region --scheduler local. Example: companion campaign robustness --count 500"""
CAMPAIGNS = Path("campaigns")


def run(
    what: Annotated[list[str], typer.Argument(metavar="STUDY | replay [FOLDER] ID", help="See above.")],
    count: Annotated[
        int | None, typer.Option("--count", metavar="N", help="Flights (of every grid point), not the study's.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Another seed than the study's.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="The campaign's folder; default ./campaigns/<name>.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="WHERE", help='Run on Dask: "local", or tcp://HOST:PORT of a cluster.'),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", min=1, help="Processes; default one per core.")
    ] = None,
    guarded: Annotated[
        bool | None,
        typer.Option("--guarded/--unguarded", help="With replay: as it would fly (default), or past gates and guards."),
    ] = None,
    mavlink: Annotated[
        bool | None,
        typer.Option("--mavlink/--no-mavlink", help="With replay: fly it over MAVLink as well (default), or not."),
    ] = None,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Runs a campaign, or flies one flight of it again."""
    if what[0] == "replay":
        from companion.cli.campaign_replay import replay

        _refuse("a replay", {"--count": count, "--seed": seed, "--scheduler": scheduler, "--workers": workers})
        folder, number = _flight_of(what[1:])
        flies, guards = mavlink is not False, guarded is not False
        raise typer.Exit(replay(folder, number, out, mavlink=flies, guarded=guards, engine=engine, as_json=as_json))
    if len(what) != 1:
        raise InputError(f"one study at a time; {' '.join(what[1:])!r} is too much (see `companion campaign --help`)")
    _refuse("a campaign", {"--guarded/--unguarded": guarded, "--mavlink/--no-mavlink": mavlink})
    if scheduler is not None and scheduler != "local" and workers is not None:
        raise InputError("--workers is for this machine; a cluster has the workers that it has")
    from companion import accelerate
    from companion.campaign.engines import check_scheduler
    from companion.campaign.store import require_pyarrow
    from companion.campaign.study import load_study

    if scheduler is not None:
        check_scheduler(scheduler)
    require_pyarrow()
    chosen = accelerate.resolve(engine)
    changes = {key: value for key, value in (("count", count), ("seed", seed)) if value is not None}
    study = load_study(what[0], changes)
    folder = out or CAMPAIGNS / study.name
    if chosen == "python":
        say("without numba a flight takes some hundred times as long: the extra [campaign] has it", quiet=as_json)
    ran = _run(study, folder, scheduler, workers, chosen, as_json)
    from companion.campaign.report import write_report

    page = write_report(folder)
    if as_json:
        print(json.dumps({**ran.summary, "folder": str(folder), "report": str(page)}, indent=2))
        return
    _say(ran, study, page)


def _refuse(what: str, options: Mapping[str, object]) -> None:
    """Raise InputError where an option is given that would change nothing."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        verb = "mean" if len(given) > 1 else "means"
        raise InputError(f"{', '.join(given)}: {verb} nothing for {what} (see `companion campaign --help`)")


def _run(study: Study, folder: Path, scheduler: str | None, workers: int | None, engine: str, as_json: bool) -> Ran:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from companion.campaign import engines, run

    def fleet() -> Fleet:
        if scheduler is not None:
            return engines.Dask(scheduler, workers)
        return engines.Processes(workers)

    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("flights, left"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    told = False

    def progress(done: run.Progress) -> None:
        nonlocal told
        bar.update(task, completed=done.done, total=done.total)
        if not told and done.done:
            told = True
            say(f"{study.name}: {done.done} of {done.total} flights are there already", quiet=True)
        told = True

    try:
        with bar:
            task = bar.add_task(study.name, total=study.total)
            return run.run(study, folder, fleet, engine, progress)
    except KeyboardInterrupt:
        say(f"interrupted; what is finished is kept in {folder}: the same command goes on", quiet=True)
        raise


def _flight_of(words: list[str]) -> tuple[Path, int]:
    """Folder and number of replay's arguments. Raises InputError."""
    if not 1 <= len(words) <= 2:
        raise InputError("replay takes a campaign's folder and a flight's number: companion campaign replay FOLDER ID")
    try:
        number = int(words[-1])
    except ValueError:
        raise InputError(f"replay: {words[-1]!r} is not the number of a flight") from None
    if len(words) == 2:
        return Path(words[0]), number
    found = [path for path in CAMPAIGNS.glob("*/study.json")] if CAMPAIGNS.is_dir() else []
    if not found:
        raise InputError("replay: there is no campaign in ./campaigns; name its folder before the number")
    return max(found, key=lambda path: path.stat().st_mtime).parent, number


def _say(ran: Ran, study: Study, page: Path) -> None:
    from companion.campaign.pictures import label

    s = ran.summary
    low, high = s["converged_share_95"]
    if ran.flown:
        each = ran.wall_s / ran.flown
        say(f"{ran.flown} flights in {ran.wall_s:.1f} s ({each * 1e3:.1f} ms each), {ran.memory_mb:.0f} MB per worker")
    say(
        f"{s['study']}: {s['converged']} of {s['flights']} flights converged, {100 * s['converged_share']:.1f} %"
        f" ({100 * low:.1f} to {100 * high:.1f} % with 95 % confidence)"
    )
    others = {k: v for k, v in s["ended"].items() if k != "flown"}
    if others:
        say("  " + ", ".join(f"{count} {kind}" for kind, count in others.items()))
    say(f"  {'':28s} {'5 %':>10s} {'median':>10s} {'95 %':>10s} {'largest':>10s}")
    for name in ("settled_at_s", "rms_m", "max_m", "saturated_s", "thrust_min_n", "tilt_max_rad", "actuation_rad_s2"):
        found: dict[str, Any] | None = s["measures"][name]
        if found is not None:
            say(f"  {label(name):28s} " + " ".join(f"{found[k]:10.4g}" for k in ("p5", "p50", "p95", "max")))
    ranked = [x for x in s["sensitivity"]["converged"] or s["sensitivity"]["rms_m"] if abs(x["partial"]) > x["noise"]]
    if ranked:
        about = "convergence" if s["sensitivity"]["converged"] else "rms"
        words = ", ".join(f"{x['variable']} {x['partial']:+.2f}" for x in ranked[:4])
        say(f"  what matters for {about} (partial rank correlation): {words}")
    say(f"  look at: companion campaign replay {ran.folder} {s['worst'][0]}")
    say(f"report:  {page}")
