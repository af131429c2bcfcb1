"""The command `jaxprt info`: describes the content of files."""

import importlib.metadata
import json
import math
import platform
import re
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import jax
import numpy as np

import jaxprt
from jaxprt import brdf, compile
from jaxprt.cli import inputs, options
from jaxprt.cli.options import option
from jaxprt.files import inputs as regular
from jaxprt.files import read_image
from jaxprt.scene import TexturedMaterial, load_environment, load_scene
from jaxprt.scene.environment import layout_of
from jaxprt.scene.mesh import bounds
from jaxprt.sphere import cubemap

_BRIGHTEST = (1, 10, 100)  # numbers of brightest texels whose share of the light is reported
_MERL = np.array([90, 90, 180], "<i4").tobytes()
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
_WRONG = (
    "the compiler of this installation must compute right sums, got wrong ones (see jax-ml/jax#39103): install another "
    "version of jaxlib"
)
_NAMES = 6  # most names of a file's materials that the text lists


@click.command(cls=options.Command, short_help="Describe meshes, scenes, environments, BRDFs and stores.")
@click.argument("files", metavar="PATH...", type=click.Path(exists=True, path_type=Path), nargs=-1)
@option(
    "--light-size",
    group="Light",
    type=options.Whole(1, 1024),
    default=64,
    show_default=True,
    metavar="N",
    help="Texels along the edge of the cubemap faces whose brightest texels are counted.",
)
@options.outside
@options.as_json
def command(**arguments: Any) -> None:
    """Describe the content of files: meshes and scenes, environments, BRDFs, and folders written by jaxprt.

    Without files, describe the installation: versions, the device, and whether its compiler computes right sums.

    \b
    Examples:
      jaxprt info
      jaxprt info scene.glb grace.hdr
      jaxprt info lafortune.json ngan2005_wardduer.fit gold-paint.binary
      jaxprt info kept out/ --json
    """  # noqa: D301
    chosen = SimpleNamespace(**arguments)
    if not chosen.files:
        here = installation()
        options.tell(here, _versions(here), as_json=chosen.as_json)
        if here["wrong_sums"]:
            raise ValueError(_WRONG)
        return
    facts, refused = [], []
    for path in chosen.files:
        try:
            facts.append(describe_path(path, chosen.light_size, outside=chosen.outside))
        except (ValueError, OSError) as error:
            refused.append(options.message_of(error))
    options.tell(facts, "\n".join(map(_text, facts)), as_json=chosen.as_json)
    if refused:
        raise ValueError("\n".join(refused))


def installation() -> dict[str, Any]:
    """Describes this installation, as JSON: versions, the device, and wrong sums of its compiler."""
    device = jax.devices()[0]
    versions = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "embreex")}
    return {
        "python": platform.python_version(),
        "jaxprt": jaxprt.__version__,
        **versions,
        "device": device.device_kind,
        "platform": device.platform,
        "wrong_sums": compile.wrong_sums(),
    }


def _versions(here: dict[str, Any]) -> str:
    names = ("jaxprt", "jax", "jaxlib", "numpy", "embreex")
    versions = ", ".join(f"{name} {here[name]}" for name in names)
    sums = f"{here['wrong_sums']} wrong sums" if here["wrong_sums"] else "right"
    return f"{versions}, Python {here['python']}\ndevice {here['platform']}, {here['device']}\ncompiler {sums}"


def describe_path(path: Path, light_size: int, *, outside: bool) -> dict[str, Any]:
    """Describes the content of a file or folder, as JSON."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        description = {"path": str(path), **_describe_file(path, light_size, outside)}
    if caught:
        description["left_out"] = [str(warning.message) for warning in caught]
    return description


def _describe_file(path: Path, light_size: int, outside: bool) -> dict[str, Any]:
    if path.is_dir():
        return _folder(path)
    kind = inputs.kind(path)
    if kind == "mesh":
        return _scene(path, outside)
    if kind == "light":
        return _light(path, light_size)
    return _brdf(path)


def _scene(path: Path, outside: bool) -> dict[str, Any]:
    scene = load_scene(path, outside=outside)
    low, high = (np.asarray(corner, float).tolist() for corner in bounds(scene.mesh))
    parts = [
        {
            "name": part.name,
            "vertices": len(part.mesh.position),
            "triangles": len(part.mesh.face),
            "texture_coordinates": part.mesh.texture is not None,
            "vertex_colors": part.color is not None,
            "material": inputs.describe(part.material),
        }
        for part in scene.parts
    ]
    cameras = [
        {
            "eye": np.asarray(camera.eye, float).tolist(),
            "target": np.asarray(camera.target, float).tolist(),
            "field_of_view_degrees": float(np.degrees(camera.field_of_view)),
        }
        for camera in scene.cameras
    ]
    total = {name: sum(part[name] for part in parts) for name in ("vertices", "triangles")}
    return {"kind": "scene", **total, "bounds": [low, high], "parts": parts, "cameras": cameras}


def _light(path: Path, size: int) -> dict[str, Any]:
    image, attributes = read_image(path)
    light = np.asarray(load_environment(path, size=size).radiance, float)
    solid = np.asarray(cubemap.solid_angle(size=size), float)
    power = np.sort((light @ _LUMINANCE * solid).ravel())[::-1]
    total = power.sum()
    colors = image[..., : 3 if image.shape[-1] > 2 else 1]
    return {
        "kind": "environment",
        "pixels": [image.shape[1], image.shape[0]],
        "channels": image.shape[2],
        "layout": layout_of(image, attributes, str(path)),
        "radiance": {"least": float(colors.min()), "most": float(colors.max())},
        "negative_pixels": int((colors < 0).any(-1).sum()),
        "mean_radiance": (np.einsum("fijc,fij->c", light, solid) / (4 * math.pi)).tolist(),
        "texels": [6, size, size],
        "brightest_share": {str(n): float(power[:n].sum() / total) if total else 0.0 for n in _BRIGHTEST},
    }


def _brdf(path: Path) -> dict[str, Any]:
    """Describes a file of BRDFs, whose format is recognized from its content."""
    regular.check(path, "a mesh, an environment or a BRDF")
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(_MERL):
        table = brdf.load_merl(path)
        return {"kind": "brdf", "form": "merl", "brdf": inputs.describe(table), "use": f"merl:{path}"}
    if path.suffix.lower() == ".bin" and path.with_name("merl_npf_materials.txt").exists():
        names = path.with_name("merl_npf_materials.txt").read_text(encoding="utf-8").split()
        brdf.load_npf(path, names[0])
        return _brdf_facts("npf", path, names)
    text = start.decode("utf-8", errors="replace")
    if path.suffix.lower() == ".json":
        known = regular.json_object(path, "a file of Lafortune BRDFs").get("materials")
        if not isinstance(known, dict) or not known:
            raise ValueError(f"{path} must be JSON with materials, got none")
        names = list(known)
        brdf.load_lafortune(path, names[0])
        return _brdf_facts("lafortune", path, names)
    if "Aggregate(Lambertian(" in text:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        names = [match[1] for match in (re.match(r"([\w-]+) *= *Aggregate", line) for line in lines) if match]
        facts = _brdf_facts("ngan", path, names)
        return {**facts, "model": type(brdf.load_ngan(path, names[0])).__name__}
    if path.suffix.lower() == ".brdf":
        samples = len(brdf.scattered.read_scattered(path)[0])
        return {"kind": "brdf", "form": "scattered", "samples": samples, "use": f"scattered:{path}"}
    known = ", ".join((*inputs.SUFFIXES, *inputs.LIGHTS))
    raise ValueError(
        f"{path} must be a mesh or an environment ({known}), a BRDF (MERL, NPF beside merl_npf_materials.txt, JSON of "
        "Lafortune's model, fits of BBM, scattered .brdf), or a folder of jaxprt; got another file"
    )


def _brdf_facts(form: str, path: Path, names: list[str]) -> dict[str, Any]:
    return {"kind": "brdf", "form": form, "materials": names, "use": f"{form}:{path},material={names[0]}"}


def _folder(path: Path) -> dict[str, Any]:
    """Describes a saved object, a store of blocks, or a folder that contains such objects or stores."""
    nbytes = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    if (path / "object.json").exists() or (path / "store.json").exists():
        try:
            return _describe_store(path, nbytes)
        except Exception as error:
            raise ValueError(f"{path} is damaged: {error}") from error
    inside = sorted({file.parent for name in ("object.json", "store.json") for file in path.rglob(name)})
    if not inside:
        raise ValueError(f"{path} must be a folder that jaxprt wrote, got one without saved objects and stores")
    return {
        "kind": "folder",
        "bytes": nbytes,
        "inside": [{"path": str(folder), **_folder(folder)} for folder in inside],
    }


def _describe_store(path: Path, nbytes: int) -> dict[str, Any]:
    """Describes a saved object or a store of blocks."""
    if (path / "object.json").exists():
        tree = json.loads(regular.json_object(path / "object.json", "the description of an object")["content"])["tree"]
        what = tree.get("class", next(iter(tree), "value")).rpartition(":")[2]
        return {"kind": "object", "holds": what, "bytes": nbytes}
    header = regular.json_object(path / "store.json", "the header of a store")
    return {
        "kind": "store",
        "holds": header.get("system", "blocks"),
        "bytes": nbytes,
        "blocks": int(header["blocks"]),
        "finished": _finished_blocks(path / "checksum.npy", header["blocks"]),
        "blocks_of": {name: shape[:-1] for name, shape in header["shapes"].items()},
    }


def _finished_blocks(path: Path, blocks: int) -> int:
    """Number of blocks with a checksum. The file grows with the last of them, so it is short until then."""
    regular.check(path, "the checksums of a store")
    with path.open("rb") as file:
        np.lib.format.read_magic(file)
        np.lib.format.read_array_header_1_0(file)
        sums = file.read(4 * blocks)
    return int(np.count_nonzero(np.frombuffer(sums[: len(sums) // 4 * 4], np.uint32)))


def _text(facts: dict[str, Any], indent: str = "") -> str:
    """The description as text."""
    rows = {"scene": _scene_rows, "environment": _light_rows, "brdf": _brdf_rows}.get(facts["kind"], _folder_rows)(
        facts
    )
    rows = [f"{indent}{facts['path']}: {rows[0]}", *(f"{indent}  {row}" for row in rows[1:])]
    rows += [f"{indent}  left out: {reason}" for reason in facts.get("left_out", [])]
    return "\n".join([*rows, *(_text(part, f"{indent}  ") for part in facts.get("inside", []))])


def _scene_rows(facts: dict[str, Any]) -> list[str]:
    (low, high), cameras = facts["bounds"], len(facts["cameras"])
    size = " x ".join(f"{b - a:.4g}" for a, b in zip(low, high, strict=True))
    rows = [
        f"scene of {len(facts['parts'])} parts, {facts['vertices']} vertices, {facts['triangles']} triangles, "
        f"{size} units, {cameras} cameras"
    ]
    for number, part in enumerate(facts["parts"]):
        material = part["material"]
        values = [
            f"{name} {_value(value)}" for name, value in material.items() if name != "model" and _matters(name, value)
        ]
        rows.append(
            f"{number} {part['name']!r}: {part['vertices']} vertices, {part['triangles']} triangles, "
            f"{material['model']}({', '.join(values)})"
        )
    for number, camera in enumerate(facts["cameras"]):
        eye = _value(camera["eye"])
        rows.append(f"camera {number}: at {eye}, {camera['field_of_view_degrees']:.4g} degrees high")
    return rows


def _matters(name: str, value: Any) -> bool:
    """Whether a parameter of a material differs from its default in glTF."""
    default = {key: standard for key, standard in inputs.describe(TexturedMaterial()).items() if key != "model"}
    return name not in default or not np.array_equal(value, default[name])


def _value(value: Any) -> str:
    if isinstance(value, list):
        return "/".join(map(_value, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _light_rows(facts: dict[str, Any]) -> list[str]:
    width, height = facts["pixels"]
    least, most = facts["radiance"].values()
    shares = ", ".join(f"{n}: {100 * share:.1f} %" for n, share in facts["brightest_share"].items())
    size = facts["texels"][1]
    return [
        f"environment of {width} x {height} pixels, {facts['channels']} channels, layout {facts['layout']}",
        f"radiance from {least:.4g} to {most:.4g}, mean over the sphere {_value(facts['mean_radiance'])}",
        f"share of the light in the brightest of 6 x {size} x {size} texels: {shares}",
    ]


def _brdf_rows(facts: dict[str, Any]) -> list[str]:
    names, rows = facts.get("materials", []), []
    if facts["form"] == "scattered":
        rows.append(f"scattered measurements, {facts['samples']} samples")
    elif names:
        rows.append(
            f"BRDFs ({facts['form']}) of {len(names)} materials: {', '.join(names[:_NAMES])}"
            f"{', ..' if len(names) > _NAMES else ''}"
        )
        rows += [f"model: {facts['model']}"] if "model" in facts else []
    else:
        rows.append(f"BRDF (MERL), {100 * facts['brdf']['filled']:.1f} % of its cells above the horizon filled")
    return [*rows, f"use: --brdf {facts['use']}"] if facts["use"] else rows


def _folder_rows(facts: dict[str, Any]) -> list[str]:
    if facts["kind"] == "folder":
        return [f"folder of {len(facts['inside'])} objects and stores, {facts['bytes']:,} bytes"]
    rows = f"{facts['kind']} of {facts['holds']}, {facts['bytes']:,} bytes"
    return [f"{rows}, {facts['finished']} of {facts['blocks']} blocks are finished" if "blocks" in facts else rows]
