"""The ``clipmap`` command: finds the subcommand, turns errors into one sentence and an exit code."""

import os
import signal
import sys
from importlib import import_module
from types import FrameType
from typing import Final, NoReturn

import click

from cli.exit_codes import INTERRUPTED, STORAGE, exit_code
from cli.startup import QuickEnd, start_lean
from schemas.errors import ClipmapError

COMMANDS: Final = {
    "build": "Build a layer of a dataset from a source image or elevation model.",
    "batch": "Build many datasets, side by side, with one report.",
    "light": "Build a layer of light from a dataset's heights and a sun.",
    "normals": "Build a layer of normals from a dataset's heights.",
    "plan": "Say which effects of light a scene calls for on a dataset.",
    "inspect": "Show a dataset, a level, a block or the values at a place.",
    "verify": "Check a dataset: files, digests, samples, seams.",
    "diff": "Compare two datasets: fields, blocks, samples.",
    "export": "Write a layer as pmtiles, cog, dzi or exr.",
    "copy": "Copy a dataset to another folder or store, or into archives.",
    "serve": "Serve datasets over HTTP.",
    "view": "Render a dataset, in a window or headless.",
    "accuracy": "Measure what accuracy costs in time, on a source or a built-in terrain.",
    "demo": "Build, serve and render a built-in terrain.",
}
"""Commands and their one-line help. Kept here so that ``clipmap --help`` imports none of them."""


class LazyGroup(click.Group):
    """A group that imports a command's module only when that command is run."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the work."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command, None if there is no such one."""
        if cmd_name not in COMMANDS:
            return None
        command = import_module(f"cli.commands.{cmd_name}").command
        if not isinstance(command, click.Command):
            raise TypeError(cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="clipmap", prog_name="clipmap")
def cli() -> None:
    """Turn huge satellite images and elevation models into clipmap-ready datasets, and stream them to viewers.

    Exit status: 0 done, 1 a check found something wrong or a job of a batch failed, 2 usage, 3 bad input, 4 reading or writing failed.
    """


def run(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code; a user's mistake ends in one sentence on stderr."""
    try:
        result = cli.main(args=arguments, prog_name="clipmap", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except SystemExit:  # how click ends when the reader of a pipe has gone
        return STORAGE
    except (click.ClickException, click.Abort, ClipmapError, OSError, KeyboardInterrupt, _TerminatedError) as error:
        return _ended(error)
    return result if isinstance(result, int) else 0


def _ended(error: BaseException) -> int:
    """Say on stderr why the command ended, in one sentence, and return its exit code."""
    match error:
        case click.ClickException():
            _show(error)
            code = error.exit_code
        case ClipmapError():
            click.echo(f"clipmap: {error}", err=True)
            code = exit_code(error)
        case _TerminatedError():
            click.echo("clipmap: terminated", err=True)
            code = 128 + error.number
        case OSError():
            # Nothing more can be written to standard output: not by us, and not by Python when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            if not isinstance(error, BrokenPipeError):
                click.echo(f"clipmap: {error.filename or 'standard output'}: {error.strerror}", err=True)
            code = STORAGE
        case _:
            click.echo("clipmap: interrupted", err=True)
            code = INTERRUPTED
    # What is kept, and how to go on. Of an interrupt, click raises another error in its place.
    for note in getattr(error, "__notes__", []) or getattr(error.__context__, "__notes__", []):
        click.echo(f"note: {note}", err=True)
    return code


def _show(error: click.ClickException) -> None:
    """Print a mistake on the command line as one sentence; no arguments at all are no mistake but a call for help."""
    if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):  # since click 8.2
        error.show()
        return
    context = getattr(error, "ctx", None)
    hint = "" if context is None else f" (see {context.command_path} --help)"
    click.echo(f"clipmap: {error.format_message().rstrip('.')}{hint}", err=True)


class _TerminatedError(BaseException):
    """SIGTERM or SIGHUP came: like an interrupt, what is unfinished is cleaned up on the way out."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise _TerminatedError(number)


def main() -> None:
    """Entry point of the console script."""
    start_lean()
    end = QuickEnd()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _terminate)
    sys.exit(end.with_code(run()))
