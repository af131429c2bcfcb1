"""The command `jaxprt splats`: a cloud of Gaussian splats in another light."""

import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import click
import jax.numpy as jnp
import numpy as np

from jaxprt.cli import inputs, options
from jaxprt.files import outputs
from jaxprt.scene import Environment, builtin, load_environment, load_scene
from jaxprt.scene.environment import rotate
from jaxprt.sensors import splats as clouds

_FILE = click.Path(exists=True, path_type=Path, dir_okay=False)
_UP = ("x", "y", "z", "-x", "-y", "-z")


@options.command(
    "splats",
    click.Argument(["cloud"], type=_FILE),
    click.Argument(["proxy"], type=_FILE),
    click.Argument(["light"], type=_FILE, required=False),
    Light=[
        {"captured": (_FILE,), "up": (click.Choice(_UP), "y")},
        {"stops": (options.Range(-100.0, 100.0, kind=float, name="N|auto", auto=None),)},
    ],
    Transport=[
        {"degree": (options.Range(0, 14), 2), "bounces": (options.Range(0), 0), "rays": (options.Range(2, 64), 8)}
    ],
    Output=[
        click.Option(
            ["--output", "-o"],
            type=click.Path(path_type=Path, dir_okay=False),
            default="relit.ply",
            show_default=True,
            metavar="FILE",
            help="The relit cloud, *.ply.",
        ),
        {"store": (click.Path(path_type=Path, file_okay=False),)},
        options.JSON,
    ],
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Relight a cloud of Gaussian splats.

    CLOUD is a binary PLY file of 3-D Gaussian splats. PROXY is a mesh of the same object in the same coordinates, which
    casts the shadows. LIGHT is an environment (EXR, HDR); without it the light is the embedded daylight.

    The output has relit colors that do not depend on the view, and all other fields of the cloud. Splats count as
    diffuse. Their albedo is guessed: it is the color of the cloud over the captured light.

    \b
    Examples:
      jaxprt splats cloud.ply proxy.glb grace.hdr --output relit.ply
      jaxprt splats cloud.ply proxy.glb grace.hdr --captured studio.hdr --up -y --degree 3 --bounces 1

    Options:
        captured: Light of the training pictures.  [default: white, the same from all directions]
        up: Axis of the cloud that points up. Environments have +y up.
        stops: Exposure of the colors in stops.  [default: auto, from their 99th percentile]
        degree: Largest degree of the spherical harmonics of light.
        bounces: How often the proxy reflects light before it arrives.
        rays: Texels along the edge of a cube through whose middles rays go from each splat.
        store: Folder that keeps precomputed data for later runs.
    """  # noqa: D301
    path = outputs.target(chosen.output, ".ply")
    options.make_folder(chosen.store)
    light = _light(chosen.light, chosen.up)
    captured = None if chosen.captured is None else _light(chosen.captured, chosen.up)
    start, processor = time.perf_counter(), time.process_time()
    splats, proxy = clouds.load_splats(chosen.cloud), load_scene(chosen.proxy)
    options_of_run = {"path": chosen.store and str(chosen.store), "progress": sys.stderr.isatty()}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* get no light")  # the result counts them
        transport = clouds.splat_transport(
            splats, proxy, degree=chosen.degree, bounces=chosen.bounces, size=chosen.rays, **options_of_run
        )
    albedo = clouds.albedo_guess(splats, transport, captured)
    clouds.write_splats(path, clouds.relit(splats, transport, albedo, light, stops=chosen.stops))
    value = {
        "splats": len(splats),
        "triangles": sum(len(part.mesh.face) for part in proxy.parts),
        "coefficients": transport.basis.count,
        "dark": len(transport.dark),
        "error": transport.error,
        "seconds": time.perf_counter() - start,
        "processor_seconds": time.process_time() - processor,
        "output": path,
    }
    return options.Result(value, _text(value))


def _light(path: Path | None, up: str) -> Environment:
    """The light of a file, or daylight, turned to the cloud's axes."""
    size = inputs.LIGHT_SIZE
    light = builtin.daylight(size=size) if path is None else load_environment(path, size=size)
    turn = np.array(inputs.UPRIGHT[up[-1]], float)
    if up.startswith("-"):
        turn = np.diag([1.0, -1.0, -1.0]) @ turn
    return light if up == "y" else rotate(light, jnp.asarray(turn.T, jnp.float32))


def _text(value: dict) -> str:
    """The result as text."""
    dark = f", {value['dark']} of them get no light" if value["dark"] else ""
    return (
        f"{value['splats']} splats{dark}; {value['triangles']} triangles\n"
        f"transport: {value['coefficients']} coefficients, relative L2 error {value['error']:.1%}\n"
        f"{value['seconds']:.1f} s, {value['processor_seconds']:.1f} s of the processor; {value['output']}"
    )
