"""`jaxprt completion`: the script with which a shell completes commands."""

from types import SimpleNamespace

import click
from click.shell_completion import get_completion_class

from jaxprt.cli import options


@options.command("completion", click.Argument(["shell"], type=click.Choice(("bash", "zsh", "fish"))))
def command(chosen: SimpleNamespace) -> None:
    """Print the script with which a shell completes commands, options, materials and files.

    \b
    Examples:
      jaxprt completion bash >> ~/.bashrc
      jaxprt completion zsh >> ~/.zshrc
      jaxprt completion fish > ~/.config/fish/completions/jaxprt.fish
    """  # noqa: D301
    kind = get_completion_class(chosen.shell)
    if kind is not None:
        click.echo(kind(command, {}, "jaxprt", "_JAXPRT_COMPLETE").source())
