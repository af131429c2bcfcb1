"""The command line: `jaxprt`, and `python -m jaxprt`."""

import importlib
import os
import sys
import threading
import warnings
from typing import Any

import click
import tqdm

import jaxprt

_INTERRUPTED = 130
COMMANDS = {  # their modules, and what `jaxprt --help` says of them
    "relight": ("relight", "Render a scene under lights, and measure errors."),
    "lights": ("lights", "Draw a scene in many lights, on one sheet."),
    "view": ("play", "Show a scene in the interactive viewer in a browser."),
    "plan": ("planned", "Find the smallest system that meets an error."),
    "measure": ("measure", "Measure errors, times and sizes of a scene or of a BRDF's fit."),
    "export": ("export", "Export web pages, baked glTF, and light probes."),
    "dataset": ("dataset", "Render pictures of many scenes under many lights, for training."),
    "daylight": ("daylight", "What sensors of a building receive in a year."),
    "splats": ("splats", "Relight a cloud of Gaussian splats."),
    "info": ("info", "Describe meshes, scenes, environments, BRDFs and stores."),
    "completion": ("completion", "Print the script for completion in bash, zsh or fish."),
}


class Refused(click.ClickException):
    """Wrong input: what was required, and what was given."""

    exit_code = 2


class Program(click.Group):
    """Group of all commands. Errors end a command with a message and an exit status instead of a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The commands in the order in which they are usually used."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """A command, whose module is imported now."""
        known = cmd_name in COMMANDS
        return importlib.import_module(f"jaxprt.cli.{COMMANDS[cmd_name][0]}").command if known else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, words) for name, (_, words) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Runs a command."""
        warnings.showwarning = lambda message, *_, **__: click.echo(f"Warning: {message}", err=True)
        try:
            return super().invoke(ctx)
        except (BrokenPipeError, click.exceptions.Exit, click.Abort):  # from `| head`, for example, and of click itself
            raise
        except KeyboardInterrupt:
            click.echo("jaxprt: stopped; the same command goes on from here", err=True)
            ctx.exit(_INTERRUPTED)
        except (ValueError, TypeError, FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
            raise Refused(_message_of(error)) from error
        except (OSError, RuntimeError, MemoryError) as error:
            raise click.ClickException(_message_of(error)) from error


def _message_of(error: Exception) -> str:
    """The message for users; imported where a command has failed and has imported it itself."""
    return importlib.import_module("jaxprt.cli.options").message_of(error)


_EPILOG = """\b
Materials, for --brdf and --material:
  models      lambert, phong, blinn-phong, ashikhmin-shirley, ward, ward-duer, cook-torrance,
              lafortune, poulin-fournier, poulin-fournier-grooves, ggx, ggx-interface, charlie, metallic-roughness
  numbers     ward:diffuse=.1/.05/.02,specular=.3,along=.1,across=.3   colors have slashes
  files       merl:FILE, npf:FILE,material=..[,names=..], lafortune:FILE,material=.., ngan:FILE,material=..,
              scattered:FILE[,smoothing=..]
"""


@click.group(
    cls=Program, epilog=_EPILOG, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(jaxprt.__version__, "-V", "--version", prog_name="jaxprt")
def program() -> None:
    """Relight 3-D scenes by precomputed radiance transfer, and measure errors and times.

    Commands take FILEs in any order: meshes and scenes (GLB, glTF, OBJ, PLY, STL, OFF) and environments (EXR, HDR).
    Without files they use an embedded scene and embedded lights. `jaxprt COMMAND --help` shows examples.

    Exit status: 0 for success, 1 for failures, 2 for wrong input, 130 after Ctrl-C.
    """


def run() -> None:
    """Runs the command line and ends the process."""
    status = _INTERRUPTED
    try:
        program(prog_name="jaxprt")
    except SystemExit as end:
        status = end.code
    except KeyboardInterrupt:
        pass
    _end(status)


def _end(status: Any) -> None:
    """Ends the process without waiting for threads of a viewer, which cannot be stopped in compiled code."""
    if any(thread.daemon and not isinstance(thread, tqdm.TMonitor) for thread in threading.enumerate()):
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status if isinstance(status, int) else 0 if status is None else 1)
    sys.exit(status)
