"""Options of commands, with the names, defaults and docstrings of the functions that the commands call; and results."""

import collections
import contextlib
import dataclasses
import inspect
import itertools
import json
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
from click.shell_completion import CompletionItem

from jaxprt.cli import inputs
from jaxprt.files import outputs
from jaxprt.relit import Clusters, Dynamic, Harmonics, Lobes, Terms, registry
from jaxprt.relit.build import precompute
from jaxprt.relit.recipes import Recipe
from jaxprt.scene import Environment

LAPLACIAN = {"none": 1.0, "laplacian": 0.4}  # fraction of the squared Laplacian that each window preserves
RECIPES: dict[str, type[Recipe]] = {
    "lobe": Lobes,
    "harmonic": Harmonics,
    "separable": Terms,
    "clusters": Clusters,
    "dynamic": Dynamic,
}


@dataclasses.dataclass(frozen=True)
class Result:
    """What a command prints: a value as JSON, or a text; then it fails with an error if there is one."""

    value: Any
    text: str
    error: Exception | None = None


class Command(click.Command):
    """A command whose help lists options in groups."""

    groups: dict[str, list[click.Option]]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes a section for each group."""
        for name, members in (self.groups | {"Options": [self.get_help_option(ctx)]}).items():
            with formatter.section(name):
                formatter.write_dl([record for member in members if member and (record := member.get_help_record(ctx))])


def command(name: str, *arguments: click.Argument, **groups: list[Any]) -> Callable[[Callable], Command]:
    """A decorator that makes a command of a function from options to a result, which the command prints.

    Args:
        name: The word that users type after `jaxprt`.
        arguments: Arguments that users give by position.
        groups: Options by the title of their section in the help. A dictionary in the list maps names of options to
            their types and defaults; the function's docstring describes these options.
    """

    def decorate(function: Callable[[SimpleNamespace], Result | None]) -> Command:
        def run(**values: Any) -> None:
            as_json = values.get("json", False)
            with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
                result = function(SimpleNamespace(**values))
            if result is not None:
                click.echo(json.dumps(finite(result.value), indent=2, allow_nan=False) if as_json else result.text)
                if result.error is not None:
                    raise result.error

        words, members = described(function), {}
        for title, group in groups.items():
            members[title] = [
                option(key, words[key], value[0], default=value[1] if value[1:] else None) if key else value
                for member in group
                for key, value in (member if isinstance(member, dict) else {"": member}).items()
            ]
        text, _, _ = (inspect.getdoc(function) or "").partition("\n\nOptions:\n")
        parameters = [*arguments, *itertools.chain(*members.values())]
        result = Command(name, callback=run, params=parameters, help=text)
        result.groups = members
        return result

    return decorate


def call(function: Callable, chosen: SimpleNamespace, **more: Any) -> Any:
    """The result of a function whose parameters are options, for the chosen values and others that are given here."""
    known = inspect.signature(function).parameters
    return function(**{name: value for name, value in vars(chosen).items() if name in known} | more)


def option(name: str, words: str, kind: Any, *, default: Any = None) -> click.Option:
    """An option whose help shows its default and its range. One whose default is () may be given several times."""
    names = [f"--{name.replace('_', '-')}", name]
    if kind is bool:
        return click.Option(names, is_flag=True, help=words)
    item = kind.item if isinstance(kind, Several) else kind
    if isinstance(item, Range) and item.limits:
        words += f"  [{item.limits.removeprefix('of ')}]"
    shown = default is not None and default is not True and default != ()
    more = {"show_default": shown, "multiple": default == ()}
    return click.Option(names, type=kind, default=default, help=words, **more)


def described(documented: Any) -> collections.defaultdict[str, str]:
    """The first sentence of a docstring on each argument or attribute, with what it says of None as the default."""
    # `python -OO` leaves docstrings out.
    entries = re.findall(r"^    (\w+): (.*(?:\n        .*)*)", inspect.getdoc(documented) or "", re.MULTILINE)
    result = collections.defaultdict(str)
    for name, text in entries:
        sentences = re.split(r"(?<=\.) +(?=[A-Z])", " ".join(text.split()))
        defaults = [sentence[len("If None, ") : -1] for sentence in sentences if sentence.startswith("If None, ")]
        result[name] = sentences[0] + "".join(f"  [default: {default}]" for default in defaults)
    return result


def options_of(function: Callable, **kinds: Any) -> list[click.Option]:
    """Options for parameters of a function, by the types of their values; all else is the function's."""
    words, known = described(function), inspect.signature(function).parameters
    return [option(name, words[name], kind, default=known[name].default) for name, kind in kinds.items()]


class Range(click.ParamType):
    """A finite number in a range, or a word that stands for a value."""

    def __init__(
        self,
        low: int | float = -math.inf,
        high: int | float = math.inf,
        *,
        kind: type = int,
        open: bool = False,
        name: str = "N",
        **words: Any,
    ):
        """Takes the ends, `int` or `float`, whether the ends are excluded, the name in the help, and the words."""
        self._low, self._high, self._kind, self._open, self.name, self._words = low, high, kind, open, name, words
        least, most = f"{'above' if open else 'of at least'} {low:g}", f"{'below' if open else 'of at most'} {high:g}"
        ends = [text for end, text in ((low, least), (high, most)) if math.isfinite(end)]
        self.limits = f"from {low:g} to {high:g}" if len(ends) == 2 and not open else " and ".join(ends)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parses the number or the word."""
        if not isinstance(value, str) or value in self._words:
            return self._words.get(value, value)
        number = None
        with contextlib.suppress(ValueError):
            number = self._kind(value)
            inside = self._low <= number <= self._high and abs(number) < math.inf
            if inside and not (self._open and number in (self._low, self._high)):
                return number
        what = " ".join(["a whole number" if self._kind is int else "a finite number", self.limits]).strip()
        words = "".join(f', or "{word}"' for word in self._words)
        self.fail(f"must be {what}{words}, got {repr(value) if number is None else value}", param, ctx)


class Several(click.ParamType):
    """Values separated by commas."""

    def __init__(self, item: click.ParamType):
        """Takes the type of each value."""
        self.item, self.name = item, item.name

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """The name of the values in help and usage."""
        choices = getattr(self.item, "choices", None)
        return f"[{'|'.join(choices)}],.." if choices else f"{self.name.upper()},.."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple:
        """Parses the values and removes duplicates."""
        if isinstance(value, tuple):
            return value
        return tuple(dict.fromkeys(self.item(word.strip(), param, ctx) for word in str(value).split(",")))

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Completes the last value."""
        before, comma, last = incomplete.rpartition(",")
        items = self.item.shell_complete(ctx, param, last)
        return [CompletionItem(f"{before}{comma}{item.value}", item.type, item.help) for item in items]


class Material(click.ParamType):
    """A material, given by a model and its parameters, or by a file; that of a part as PART=MATERIAL."""

    def __init__(self, *, of_part: bool = False):
        """Takes whether the value names a part."""
        self._of_part, self.name = of_part, "part=material" if of_part else "material"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parses the material."""
        if not isinstance(value, str):
            return value
        try:
            if not self._of_part:
                return inputs.parse(value)
            part, material = inputs.of_part(value)
            return part, inputs.parse(material)
        except (ValueError, OSError) as error:
            self.fail(message_of(error), param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Completes the name, then its parameters."""
        name, colon, rest = incomplete.partition(":")
        if not colon:
            names = dict.fromkeys([*registry.materials(), *inputs.FILES])
            return [CompletionItem(f"{known}:") for known in names if known.startswith(name)]
        before, comma, last = rest.rpartition(",")
        known = inputs.parameters(name) if name in registry.materials() else {}
        return [CompletionItem(f"{name}:{before}{comma}{key}=") for key in known if key.startswith(last)]


class SystemName(click.Choice):
    """Names of systems: some of jaxprt's, and those of other packages."""

    @property
    def choices(self) -> tuple[str, ...]:
        """All names."""
        return (*self._names, *(name for name in registry.systems() if name not in RECIPES))

    @choices.setter
    def choices(self, names: tuple[str, ...]) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self._names = names


FRACTION = Range(0.0, 1.0, kind=float, open=True, name="E")
DEGREES = Range(kind=float, name="degrees")
ELEVATION = Range(-90.0, 90.0, kind=float, name="degrees")
PIXELS = Range(1, 8192)
BOUNCES = Range(0, name="N|all", all="all")
REFINE = Range(0.0, kind=float, name="E|off", off=False)
_SIZES: dict[str, click.ParamType] = {"lobes": Several(Range(1, 64)), "texels": Range(0)}
_SIZES |= dict.fromkeys(("terms", "keep", "components", "modes"), Range(1))

FILES = click.Argument(["files"], metavar="[FILE]...", type=click.Path(exists=True, path_type=Path), nargs=-1)
SCENE = options_of(
    inputs.scene,
    up=click.Choice(list(inputs.UPRIGHT)),
    ground=bool,
    refine=REFINE,
    outside=bool,
    brdf=Material(),
    material=Material(of_part=True),
)
CAMERA = options_of(inputs.camera, azimuth=DEGREES, elevation=ELEVATION, size=PIXELS)
LIGHT_SIZE = options_of(inputs.lights, light_size=Range(1, 1024))
LIGHT = [*options_of(inputs.lights, turn=Several(DEGREES)), *LIGHT_SIZE]
JSON = option("json", "Print the result as JSON on stdout.", bool)
PLAN = options_of(precompute, error=FRACTION, bounces=BOUNCES)
NO_BOUNCES = option("bounces", described(precompute)["bounces"].partition("  [")[0], BOUNCES, default=0)
PLANNED = ("planned", *RECIPES)


def systems(names: Sequence[str], words: str, *, default: str | None = "lobe") -> click.Option:
    """The option --system."""
    return option("system", words, Several(SystemName(names)), default=default and (default,))


def layers(words: str) -> click.Option:
    """The option --layers."""
    return option("layers", words, Several(click.Choice(list(outputs.LAYERS))))


def folder(words: str, *, default: str | None = None) -> click.Option:
    """The option --output for a folder."""
    return option("output", words, click.Path(path_type=Path), default=default)


def _defaults(size: str) -> dict[str, int]:
    """The systems that have a size, with its default values."""
    values = {name: getattr(recipe(), size, None) for name, recipe in RECIPES.items()}
    return {name: value for name, value in values.items() if value is not None}


def sizes(*names: str) -> list[click.Option]:
    """Options for some sizes of systems, or all, as their recipes describe them."""
    result = []
    for name in names or _SIZES:
        words: dict[str, list[str]] = {}
        for system, value in _defaults(name).items():
            words.setdefault(re.split("[;.]", described(RECIPES[system])[name])[0], []).append(f"{system} {value}")
        text = "; ".join(f"{sentence} [default: {', '.join(values)}]" for sentence, values in words.items())
        text += "; several numbers make several systems" * (name == "lobes")
        result.append(option(name, text, _SIZES[name]))
    order = option("order", "Bands of spherical harmonics (harmonic); N^2 coefficients.", Range(1, 15), default=5)
    window = "Window against ringing on glossy parts (harmonic)."
    return [*result, order, option("window", window, click.Choice(list(LAPLACIAN)), default="laplacian")]


FEW_SIZES = sizes("lobes", "texels")  # of systems that pages show


def check(chosen: SimpleNamespace, systems: Sequence[str], light: Environment) -> None:
    """Refuses size options that none of the systems uses, or that exceed the size of the light.

    Raises:
        ValueError: A size belongs to another system, or there are more wavelet coefficients than texels.
    """
    for name in _SIZES:
        takers = _defaults(name)
        if getattr(chosen, name) is not None and not set(takers) & set(systems):
            raise ValueError(f"--{name} needs --system {' or '.join(takers)}, got {','.join(systems)}")
    texels = 6 * light.radiance.shape[-2] ** 2
    if chosen.keep is not None and chosen.keep > texels:
        raise ValueError(f"--keep must be at most {texels}, got {chosen.keep}")


def recipes(system: str, chosen: SimpleNamespace) -> dict[str, Recipe]:
    """The recipes for a system and the options, by names that are used for folders and files."""
    if system not in RECIPES:
        return {system: registry.systems()[system]}
    if system == "harmonic":
        return {system: Harmonics(chosen.order - 1, LAPLACIAN[chosen.window])}
    recipe, sizes = RECIPES[system], {name: getattr(chosen, name, None) for name in _SIZES if name != "lobes"}
    values = {name: value for name, value in sizes.items() if value is not None and hasattr(recipe(), name)}
    if system not in _defaults("lobes"):  # those with lobes are `Lobes` and `Dynamic`
        return {system: recipe(**values)}
    counts = chosen.lobes or (_defaults("lobes")[system],)
    names = [system] if len(counts) == 1 else [f"{system}_{count}" for count in counts]
    # Tensors are shipped for the default number of lobes.
    without = {count: {"ranks": None} if system == "dynamic" and count != Dynamic().lobes else {} for count in counts}
    with_lobes: Any = recipe
    return {
        name: with_lobes(lobes=count, **without[count], **values) for name, count in zip(names, counts, strict=True)
    }


def recipe(chosen: SimpleNamespace, what: str) -> Recipe:
    """The recipe of a command that takes one system and one size of it."""
    if len(chosen.system) > 1 or len(chosen.lobes or ()) > 1:
        raise ValueError(f"{what} takes one system and one number of lobes, got several")
    return next(iter(recipes(chosen.system[0], chosen).values()))


def make_folder(path: Path | None, *, name: str = "--output") -> None:
    """Creates the folder of the option `name`, if it is given, before anything is computed."""
    if path is None:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{name} must be a folder that can be made, got {path}: {error.strerror}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise ValueError(f"{name} must be a folder that can be written to, got {path}")


def message_of(error: Exception) -> str:
    """The message of an error, without error numbers of the operating system."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def finite(value: Any) -> Any:
    """A value that JSON can represent: arrays become lists, and numbers that are not finite null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
