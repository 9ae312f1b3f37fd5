"""The command line: one module per command, imported only when that command is called.

`main` turns the errors of companion.errors into one line and an exit code; anything else is a fault of the program
(70).
"""

from __future__ import annotations

import contextlib
import errno
import functools
import importlib
import signal
import sys
import traceback
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperGroup

from companion import __version__
from companion.errors import CompanionError, ExitCode

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EIO}

COMMANDS = {
    "demo": "Fly the paper's figure of eight on the bundled vehicle.",
    "fly": "Fly a trajectory on a vehicle that is already there.",
    "check": "Check that trajectories can be flown: continuity, limits, margins.",
    "mission": "Download the autopilot's mission and geofence into a file to plan through.",
    "doctor": "Look at a connected vehicle: would a flight be refused, and why.",
    "calibrate": "Find out what a vehicle is like, by flying it, and write its vehicle file.",
    "simulate": "Compute a flight without sockets, for a quick look at gains.",
    "certify": "Check a gain set: certificate, margins, predicted extremes.",
    "campaign": "Fly thousands of simulated flights of a study, or one of them again.",
    "tune": "Search certified gains for a vehicle and a set of disturbances.",
    "upload": "Bring a trajectory to the vehicle and get its verdict.",
    "list": "Show the trajectories on the vehicle.",
    "remove": "Remove a trajectory from the vehicle.",
    "report": "Build report.html of a flight folder again.",
    "serve": "Wait on the vehicle for trajectories and commands, and fly.",
    "start": "Start a trajectory that is on the vehicle.",
    "pause": "Slow down to rest on the path, and stay there.",
    "resume": "Go on after a pause.",
    "stop": "End the flight: to rest on the path, then Hold.",
    "land": "End the flight and land.",
    "status": "Show how things stand on the vehicle, live.",
    "key": "Make a key for signed messages, and give it to the autopilot.",
    "replay": "Give a flight's states to the controller again and compare its commands.",
}
"""Every command with its line in `companion --help`; the module companion.cli.NAME holds it."""


USAGE_ERROR: Any = typer.BadParameter.__base__
"""What the parser raises for an option or a name that it does not know; typer does not export it under its name."""


class LazyGroup(TyperGroup):
    """Knows the commands by name and imports the one that is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """All commands, in the order of COMMANDS."""
        return [*COMMANDS]  # the command `list` is a module of this package, and hides the builtin

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The overview, from COMMANDS alone: no command is imported for it."""
        with formatter.section("Commands"):
            formatter.write_dl([*COMMANDS.items()])

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name, or None."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"companion.cli.{cmd_name}")
        single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
        single.command(name=cmd_name, help=COMMANDS[cmd_name] + "\n\n" + (module.__doc__ or ""), epilog=module.EXAMPLE)(
            _interruptible(module.run)
        )
        command = typer.main.get_command(single)
        command.name = cmd_name
        return command


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"companion {__version__}")
        raise typer.Exit


app = typer.Typer(
    cls=LazyGroup,
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog="Start with: companion demo",
)


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True, help="Print the version."),
) -> None:
    """Flies a PX4 multirotor along a trajectory, with a disturbance estimator and a proof behind it."""


def _interruptible(run: Callable[..., Any]) -> Callable[..., Any]:
    """The command with Ctrl-C as exit code 130, and 141 where nobody reads what it says any more, as shells have it."""

    @functools.wraps(run)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            done = run(*args, **kwargs)
            sys.stdout.flush()  # here a failure can be told
            return done
        except BrokenPipeError:
            _speak_into_nothing()
            raise typer.Exit(128 + signal.SIGPIPE) from None
        except KeyboardInterrupt:
            raise typer.Exit(int(ExitCode.INTERRUPTED)) from None

    return guarded


def _speak_into_nothing() -> None:
    """What is still to be said would fail once more when the interpreter ends."""
    from companion.cli.steady_output import speak_into_nothing

    with contextlib.suppress(OSError, ValueError):
        speak_into_nothing(sys.stdout.fileno())


def main(arguments: list[str] | None = None) -> int:
    """Runs a command line and returns its exit code (companion.errors.ExitCode)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = typer.main.get_command(app).main(
            args=arguments or ["--help"], prog_name="companion", standalone_mode=False
        )
        return code if isinstance(code, int) else int(ExitCode.DONE)
    except USAGE_ERROR as error:
        where = error.ctx.command_path if error.ctx else "companion"
        print(f"{where}: {_one_line(error.format_message())}; try '{where} --help'", file=sys.stderr)
        return int(ExitCode.BAD_INPUT)
    except typer.Abort:
        return int(ExitCode.INTERRUPTED)
    except CompanionError as error:
        print(f"companion: {error}", file=sys.stderr)
        return int(error.exit_code)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            _speak_into_nothing()
            where = f"{error.filename}: " if error.filename else "what this command says or writes: "
            print(f"companion: {where}{error.strerror}; make room, or write elsewhere", file=sys.stderr)
            return int(ExitCode.BAD_INPUT)
        traceback.print_exc()
        print("companion: this is a fault of the program; please report it with the lines above", file=sys.stderr)
        return int(ExitCode.INTERNAL)


def _one_line(message: str) -> str:
    return " ".join(message.split()).rstrip(".")


def entry() -> None:
    """The `companion` script."""
    sys.exit(main())
