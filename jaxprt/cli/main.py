"""The command line: `jaxprt`, and `python -m jaxprt`."""

import os
import sys
import threading
import warnings
from types import SimpleNamespace
from typing import Any

import click
import tqdm
from click.shell_completion import get_completion_class

import jaxprt
from jaxprt.cli import dataset, export, info, inputs, lights, measure, options, planned, play, relight
from jaxprt.relit import registry

_INTERRUPTED = 130


class Refused(click.ClickException):
    """Wrong input: what was required, and what was given."""

    exit_code = 2


class Program(click.Group):
    """Group of all commands. Errors end a command with a message and an exit status instead of a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The commands in the order in which they are usually used."""
        return list(self.commands)

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
            raise Refused(options.message_of(error)) from error
        except (OSError, RuntimeError, MemoryError) as error:
            raise click.ClickException(options.message_of(error)) from error


_EPILOG = f"""\b
Materials, for --brdf and --material:
  models      {", ".join(list(registry.MATERIALS)[:7])},
              {", ".join(list(registry.MATERIALS)[7:])}
  numbers     ward:diffuse=.1/.05/.02,specular=.3,along=.1,across=.3   colors have slashes
  files       {", ".join(map(inputs.form, inputs.FILES))}
"""


@click.group(
    cls=Program,
    commands=[module.command for module in (relight, lights, play, planned, measure, export, dataset, info)],
    epilog=_EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(jaxprt.__version__, "-V", "--version", prog_name="jaxprt")
def program() -> None:
    """Relight 3-D scenes by precomputed radiance transfer, and measure errors and times.

    Commands take FILEs in any order: meshes and scenes (GLB, glTF, OBJ, PLY, STL, OFF) and environments (EXR, HDR).
    Without files they use an embedded scene and embedded lights. `jaxprt COMMAND --help` shows examples.

    Exit status: 0 for success, 1 for failures, 2 for wrong input, 130 after Ctrl-C.
    """


@options.command(
    "completion",
    "Print the script for completion in bash, zsh or fish.",
    click.Argument(["shell"], type=click.Choice(("bash", "zsh", "fish"))),
)
def completion(chosen: SimpleNamespace) -> None:
    """Print the script with which a shell completes commands, options, materials and files.

    \b
    Examples:
      jaxprt completion bash >> ~/.bashrc
      jaxprt completion zsh >> ~/.zshrc
      jaxprt completion fish > ~/.config/fish/completions/jaxprt.fish
    """  # noqa: D301
    kind = get_completion_class(chosen.shell)
    if kind is not None:
        click.echo(kind(program, {}, "jaxprt", "_JAXPRT_COMPLETE").source())


program.add_command(completion)


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
