"""Options that several commands share, in groups, and the output of results."""

import contextlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
from click.shell_completion import CompletionItem

from jaxprt.cli import inputs
from jaxprt.relit import Clusters, Dynamic, Harmonics, Lobes, Terms, registry
from jaxprt.relit.recipes import Recipe

LAPLACIAN = {"none": 1.0, "laplacian": 0.4}  # fraction of the squared Laplacian that each window preserves
NAMES = ("lobe", "harmonic", "separable", "clusters", "dynamic")
_COUNT = 12  # default number of lobes
_TAKEN = {
    "lobes": ("lobe", "dynamic"),
    "texels": ("lobe", "clusters", "dynamic"),
    "terms": ("separable", "clusters"),
    "keep": ("separable", "clusters", "dynamic"),
    "components": ("clusters", "dynamic"),
    "modes": ("clusters", "dynamic"),
}
_PATH: Any = click.Path(path_type=Path)


def check(options: SimpleNamespace, systems: Sequence[str], texels: int) -> None:
    """Refuses size options that none of the systems uses, or that exceed the size of the light.

    Raises:
        ValueError: A size belongs to another system, or there are more wavelet coefficients than texels.
    """
    for name, takers in _TAKEN.items():
        if getattr(options, name) is not None and not set(takers) & set(systems):
            raise ValueError(f"--{name} needs --system {' or '.join(takers)}, got {','.join(systems)}")
    if options.keep is not None and options.keep > texels:
        raise ValueError(f"--keep must be at most {texels}, got {options.keep}")


def recipes(system: str, options: SimpleNamespace, *, lobes: int = _COUNT) -> dict[str, Recipe]:
    """The recipes for a system and the options, by names that are used for folders and files."""
    if system == "lobe":
        counts = options.lobes or (lobes,)
        more = {} if options.texels is None else {"texels": options.texels}
        names = [system] if len(counts) == 1 else [f"lobe_{count}" for count in counts]
        return {name: Lobes(count, **more) for name, count in zip(names, counts, strict=True)}
    if system == "harmonic":
        return {system: Harmonics(options.order - 1, LAPLACIAN[options.window])}
    if system == "dynamic":
        return _dynamic(options)
    if system not in NAMES:
        return {system: registry.systems()[system]}
    names = ("terms", "keep") if system == "separable" else ("terms", "keep", "components", "modes", "texels")
    values = {name: value for name in names if (value := getattr(options, name)) is not None}
    return {system: Terms(**values) if system == "separable" else Clusters(**values)}


def _dynamic(options: SimpleNamespace) -> dict[str, Recipe]:
    """Recipes of the dynamic system. Other numbers of lobes than by default have no tensor."""
    names = ("keep", "components", "modes", "texels")
    values = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    counts, whole = options.lobes or (), Dynamic(**values)
    if not counts:
        return {"dynamic": whole}
    names = ["dynamic"] if len(counts) == 1 else [f"dynamic_{count}" for count in counts]
    ranks = [whole.ranks if count == whole.lobes else None for count in counts]
    rows = zip(names, counts, ranks, strict=True)
    return {name: Dynamic(lobes=count, ranks=rank, **values) for name, count, rank in rows}


class Command(click.Command):
    """A command whose help lists options in groups."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes a section for each group, in the order of the options."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record is not None:
                groups.setdefault(getattr(parameter, "group", "Options"), []).append(record)
        for name, records in groups.items():
            with formatter.section(name):
                formatter.write_dl(records)


class Option(click.Option):
    """An option that belongs to a group."""

    def __init__(self, *names: Any, group: str = "Options", **more: Any):
        """Takes the group in addition to click's arguments."""
        super().__init__(*names, **more)
        self.group = group


class Finite(click.ParamType):
    """A finite number in a range."""

    name = "number"

    def __init__(self, least: float | None = None, most: float | None = None, *, open: bool = False):
        """Takes the ends of the range. With `open` the ends are excluded."""
        self._ends, self._open = (least, most), open

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parses the number."""
        number = _parse_number(float, value)
        if number is None or not math.isfinite(number) or not _inside(number, *self._ends, open=self._open):
            self.fail(
                _requirement("a finite number", *self._ends, open=self._open, number=number, value=value), param, ctx
            )
        return number


class Whole(click.IntRange):
    """A whole number in a range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Parses the number."""
        number = _parse_number(int, value)
        if number is None or not _inside(number, self.min, self.max, open=False):
            self.fail(
                _requirement("a whole number", self.min, self.max, open=False, number=number, value=value), param, ctx
            )
        return number


def _parse_number(kind: Callable, value: Any) -> Any:
    """The value as a number; None if it is none."""
    try:
        return kind(value)
    except ValueError:
        return None


def _inside(number: int | float, least: int | float | None, most: int | float | None, *, open: bool) -> bool:
    if open and number in (least, most):
        return False
    return (least is None or least <= number) and (most is None or number <= most)


def _requirement(
    what: str, least: int | float | None, most: int | float | None, *, open: bool, number: Any, value: Any
) -> str:
    """The message for a value that is not such a number, or not in the range."""
    low = "" if least is None else f" {'above' if open else 'of at least'} {least:g}"
    high = "" if most is None else f" {'below' if open else 'of at most'} {most:g}"
    both = f"{low} and{high}" if low and high else low + high
    if low and high and not open:
        both = f" from {least:g} to {most:g}"
    return f"must be {what}{both}, got {repr(value) if number is None else value}"


class Several(click.ParamType):
    """Values separated by commas."""

    def __init__(self, item: click.ParamType):
        """Takes the type of each value."""
        self.item, self.name = item, item.name

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """The name of the values in help and usage."""
        choices = getattr(self.item, "choices", None)
        return f"[{'|'.join(choices)}],.." if choices else "N,.."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple:
        """Parses the values and removes duplicates."""
        if isinstance(value, tuple):
            return value
        return tuple(dict.fromkeys(self.item(word.strip(), param, ctx) for word in str(value).split(",")))

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Completes the last value."""
        before, comma, last = incomplete.rpartition(",")
        return [
            CompletionItem(f"{before}{comma}{completion.value}", completion.type, completion.help)
            for completion in self.item.shell_complete(ctx, param, last)
        ]


class Bounces(click.ParamType):
    """The number of bounces: an integer, or "all"."""

    name = "N|all"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """Parses the number or "all"."""
        if value != "all" and not str(value).isdecimal():
            self.fail(f'must be a whole number of at least 0, or "all", got {value!r}', param, ctx)
        return value if value == "all" else int(value)


class Refinement(click.ParamType):
    """The error to which meshes are divided, or "off"."""

    name = "E|off"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | bool:
        """Parses the error; "off" gives False."""
        if isinstance(value, bool) or value == "off":
            return bool(value) and value != "off"
        try:
            error = float(value)
        except ValueError:
            error = float("nan")
        if not 0 <= error < float("inf"):
            self.fail(f'must be an error of at least 0, such as 0.02, or "off", got {value!r}', param, ctx)
        return error


class Material(click.ParamType):
    """A material, given by a model and its parameters, or by a file."""

    name = "material"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parses the material."""
        try:
            return inputs.parse(value) if isinstance(value, str) else value
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
        return [
            CompletionItem(f"{name}:{before}{comma}{parameter}=") for parameter in known if parameter.startswith(last)
        ]


class OfPart(Material):
    """A material for a part: PART=MATERIAL."""

    name = "part=material"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parses the part and its material."""
        if not isinstance(value, str):
            return value
        try:
            part, material = inputs.of_part(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        return part, super().convert(material, param, ctx)


def message_of(error: Exception) -> str:
    """The message of an error, without error numbers of the operating system."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def option(*names: str, group: str, **more: Any) -> Callable:
    """A decorator that adds an option to a command, in a group."""
    return click.option(*names, cls=Option, group=group, **more)


def together(*decorators: Callable) -> Callable:
    """Combines several decorators. The first is outermost."""

    def decorate(function: Callable) -> Callable:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


outside = option("--outside", group="Scene", is_flag=True, help="Let scenes read files outside of their folders.")
scene = together(
    click.argument("files", metavar="[FILE]...", type=click.Path(exists=True, path_type=Path), nargs=-1),
    option(
        "--up",
        group="Scene",
        type=click.Choice(list(inputs.UPRIGHT)),
        default="y",
        show_default=True,
        help="Axis of the meshes that points up.",
    ),
    option("--ground", group="Scene", is_flag=True, help="Stand the meshes on a diffuse ground plane."),
    option(
        "--refine",
        group="Scene",
        type=Refinement(),
        default=True,
        metavar="E|off",
        help="Divide the meshes of files until interpolated visibility errs by E in pictures.  [default: 0.015]",
    ),
    outside,
    option(
        "--brdf",
        group="Scene",
        type=Material(),
        metavar="MATERIAL",
        help="Material of all meshes instead of the files' own, such as ward:along=.1,across=.3 or merl:FILE.",
    ),
    option(
        "--material",
        group="Scene",
        type=OfPart(),
        multiple=True,
        metavar="PART=MATERIAL",
        help="Material of one part, given by its name or its number from 0.",
    ),
)
light_size = option(
    "--light-size",
    group="Light",
    type=Whole(1, 1024),
    metavar="N",
    help="Texels along the edge of the light's cubemap faces, a power of two.  [default: 64]",
)
light = together(
    option(
        "--turn",
        group="Light",
        type=Several(Finite()),
        default="0",
        metavar="DEGREES,..",
        help="Rotate each light by each angle about the vertical, counterclockwise as seen from above.",
    ),
    light_size,
)
camera = together(
    option(
        "--azimuth",
        group="Camera",
        type=Finite(),
        default=20.0,
        metavar="DEGREES",
        show_default=True,
        help="Azimuth of the camera, from +z towards +x.",
    ),
    option(
        "--elevation",
        group="Camera",
        type=Finite(-90.0, 90.0),
        default=15.0,
        metavar="DEGREES",
        show_default=True,
        help="Elevation of the camera above the horizon, from -90 to 90.",
    ),
    option(
        "--size",
        group="Camera",
        type=Whole(1, 8192),
        metavar="N",
        default=512,
        show_default=True,
        help="Width and height of the pictures in pixels.",
    ),
)
few_sizes = together(
    option(
        "--lobes",
        group="Sizes",
        type=Several(Whole(1, 64)),
        metavar="N,..",
        help="Lobes per BRDF (lobe, dynamic). Several numbers make several systems.  [default: 12]",
    ),
    option(
        "--texels",
        group="Sizes",
        type=Whole(0),
        metavar="N",
        help="Brightest texels that are summed one by one (lobe, clusters, dynamic).  [default: 16]",
    ),
    option(
        "--order",
        group="Sizes",
        type=Whole(1, 15),
        metavar="N",
        default=5,
        show_default=True,
        help="Bands of spherical harmonics (harmonic); N^2 coefficients.",
    ),
    option(
        "--window",
        group="Sizes",
        type=click.Choice(list(LAPLACIAN)),
        default="laplacian",
        show_default=True,
        help="Window against ringing on glossy parts (harmonic).",
    ),
)
_more_sizes = together(
    option(
        "--terms",
        group="Sizes",
        type=Whole(1),
        metavar="N",
        help="BRDF terms.  [default: 4 for separable, 32 for clusters]",
    ),
    option(
        "--keep",
        group="Sizes",
        type=Whole(1),
        metavar="N",
        help="Wavelet coefficients.  [default: 96 per vertex and term for separable, 768 per cluster for clusters, "
        "1024 for dynamic]",
    ),
    option(
        "--components",
        group="Sizes",
        type=Whole(1),
        metavar="N",
        help="Principal components along the vertices of each cluster.  [default: 16 for clusters, 24 for dynamic]",
    ),
    option(
        "--modes",
        group="Sizes",
        type=Whole(1),
        metavar="N",
        help="Principal components along the light of each cluster.  [default: 80 for clusters, 128 for dynamic]",
    ),
)
recipe = together(few_sizes, _more_sizes)
bounces = option("--bounces", group="System", type=Bounces(), help='Number of bounces between parts, or "all".')
no_bounces = option(
    "--bounces",
    group="System",
    type=Bounces(),
    default="0",
    help='Number of bounces between parts, or "all".  [default: 0]',
)
as_json = option("--json", "as_json", group="Output", is_flag=True, help="Print the result as JSON on stdout.")


class SystemName(click.Choice):
    """Names of systems: some of jaxprt's, and those of other packages."""

    @property
    def choices(self) -> tuple[str, ...]:
        """All names."""
        return (*self._names, *(name for name in registry.systems() if name not in NAMES))

    @choices.setter
    def choices(self, names: tuple[str, ...]) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self._names = names


def systems(names: Sequence[str], *, default: str | None, words: str) -> Callable:
    """The option --system."""
    return option("--system", group="System", type=Several(SystemName(names)), default=default, help=words)


def folder(words: str, *, default: str | None = None) -> Callable:
    """The option --output for a folder."""
    shown: Any = default is not None
    return option("--output", group="Output", type=_PATH, default=default, show_default=shown, help=words)


@contextlib.contextmanager
def reserve_stdout(result: bool) -> Iterator[None]:
    """Redirects other output to stderr if stdout is reserved for the result as JSON."""
    if not result:
        yield
        return
    with contextlib.redirect_stdout(sys.stderr):
        yield


def tell(result: Any, text: str, *, as_json: bool) -> None:
    """Prints a result as JSON or as text."""
    click.echo(json.dumps(finite(result), indent=2, allow_nan=False) if as_json else text)


def finite(value: Any) -> Any:
    """A value that JSON can represent. Numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
