"""The command `jaxprt info`: describes the content of files."""

import importlib.metadata
import json
import math
import platform
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import jax
import numpy as np

import jaxprt
from jaxprt import brdf, compile
from jaxprt.cli import inputs, options
from jaxprt.files import inputs as regular
from jaxprt.files import read_image
from jaxprt.files.inputs import JsonObject
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
_LIBRARIES = ("jax", "jaxlib", "numpy", "embreex")
_NAMES = 6  # most names of a file's materials that the text lists


@options.command(
    "info",
    click.Argument(["files"], metavar="PATH...", type=click.Path(exists=True, path_type=Path), nargs=-1),
    Light=[{"light_size": (options.Range(1, 1024), inputs.LIGHT_SIZE)}],
    Scene=options.options_of(load_scene, outside=bool),
    Output=[options.JSON],
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Describe the content of files: meshes and scenes, environments, BRDFs, and folders written by jaxprt.

    Without files, describe the installation: versions, the device, and whether its compiler computes right sums.

    \b
    Examples:
      jaxprt info
      jaxprt info scene.glb grace.hdr
      jaxprt info lafortune.json ngan2005_wardduer.fit gold-paint.binary
      jaxprt info kept out/ --json

    Options:
        light_size: Texels along the edge of the cubemap faces whose brightest texels are counted.
    """  # noqa: D301
    if not chosen.files:
        here = _installation()
        versions = ", ".join(f"{name} {here[name]}" for name in ("jaxprt", *_LIBRARIES))
        sums = f"{here['wrong_sums']} wrong sums" if here["wrong_sums"] else "right"
        text = f"{versions}, Python {here['python']}\ndevice {here['platform']}, {here['device']}\ncompiler {sums}"
        return options.Result(here, text, ValueError(_WRONG) if here["wrong_sums"] else None)
    facts, refused = [], []
    for path in chosen.files:
        try:
            facts.append(describe_path(path, chosen.light_size, outside=chosen.outside))
        except (ValueError, OSError) as error:
            refused.append(options.message_of(error))
    text = "\n".join(row for described in facts for row in _rows(described))
    return options.Result(facts, text, ValueError("\n".join(refused)) if refused else None)


def _installation() -> JsonObject:
    """Describes this installation, as JSON: versions, the device, and wrong sums of its compiler."""
    device = jax.devices()[0]
    return {
        "python": platform.python_version(),
        "jaxprt": jaxprt.__version__,
        **{name: importlib.metadata.version(name) for name in _LIBRARIES},
        "device": device.device_kind,
        "platform": device.platform,
        "wrong_sums": compile.wrong_sums(),
    }


def describe_path(path: Path, light_size: int, *, outside: bool) -> JsonObject:
    """Describes the content of a file or folder, as JSON."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if path.is_dir():
            facts = _folder(path)
        elif kind := inputs.kind(path):
            facts = _scene(path, outside) if kind == "mesh" else _light(path, light_size)
        else:
            facts = _brdf(path)
    left_out = {"left_out": [str(warning.message) for warning in caught]} if caught else {}
    return options.finite({"path": path, **facts, **left_out})


def _scene(path: Path, outside: bool) -> JsonObject:
    scene = load_scene(path, outside=outside)
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
        {"eye": camera.eye, "target": camera.target, "field_of_view_degrees": np.degrees(camera.field_of_view)}
        for camera in scene.cameras
    ]
    total = {name: sum(part[name] for part in parts) for name in ("vertices", "triangles")}
    return {"kind": "scene", **total, "bounds": bounds(scene.mesh), "parts": parts, "cameras": cameras}


def _light(path: Path, size: int) -> JsonObject:
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
        "radiance": {"least": colors.min(), "most": colors.max()},
        "negative_pixels": np.count_nonzero((colors < 0).any(-1)),
        "mean_radiance": np.einsum("fijc,fij->c", light, solid) / (4 * math.pi),
        "texels": [6, size, size],
        "brightest_share": {n: power[:n].sum() / total if total else 0.0 for n in _BRIGHTEST},
    }


def _brdf(path: Path) -> JsonObject:
    """Describes a file of BRDFs, whose format is recognized from its content."""
    regular.check(path, "a mesh, an environment or a BRDF")
    with path.open("rb") as file:
        start = file.read(4096)
    names, suffix = path.with_name("merl_npf_materials.txt"), path.suffix.lower()
    if start.startswith(_MERL):
        return {"kind": "brdf", "form": "merl", "brdf": inputs.describe(brdf.load_merl(path)), "use": f"merl:{path}"}
    if suffix == ".bin" and names.exists():
        return _materials("npf", path, names.read_text(encoding="utf-8").split())
    if suffix == ".json":
        known = regular.json_object(path, "a file of Lafortune BRDFs").get("materials")
        if not isinstance(known, dict) or not known:
            raise ValueError(f"{path} must be JSON with materials, got none")
        return _materials("lafortune", path, list(known))
    if b"Aggregate(Lambertian(" in start:
        text = path.read_text(encoding="utf-8", errors="replace")
        return _materials("ngan", path, re.findall(r"^([\w-]+) *= *Aggregate", text, re.MULTILINE))
    if suffix == ".brdf":
        samples = len(brdf.scattered.read_scattered(path)[0])
        return {"kind": "brdf", "form": "scattered", "samples": samples, "use": f"scattered:{path}"}
    known = ", ".join((*inputs.SUFFIXES, *inputs.LIGHTS))
    raise ValueError(
        f"{path} must be a mesh or an environment ({known}), a BRDF (MERL, NPF beside merl_npf_materials.txt, JSON of "
        "Lafortune's model, fits of BBM, scattered .brdf), or a folder of jaxprt; got another file"
    )


def _materials(form: str, path: Path, names: list[str]) -> JsonObject:
    """Describes a file of several BRDFs, of which the first must be one."""
    model = type(inputs.FILES[form][0](path, names[0])).__name__
    facts = {"kind": "brdf", "form": form, "materials": names, "use": f"{form}:{path},material={names[0]}"}
    return facts | ({"model": model} if form == "ngan" else {})


def _folder(path: Path) -> JsonObject:
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
    members = [{"path": str(folder), **_folder(folder)} for folder in inside]
    return {"kind": "folder", "bytes": nbytes, "inside": members}


def _describe_store(path: Path, nbytes: int) -> JsonObject:
    """Describes a saved object or a store of blocks."""
    if (path / "object.json").exists():
        tree = json.loads(regular.json_object(path / "object.json", "the description of an object")["content"])["tree"]
        what = tree.get("class", next(iter(tree), "value")).rpartition(":")[2]
        return {"kind": "object", "holds": what, "bytes": nbytes}
    header = regular.json_object(path / "store.json", "the header of a store")
    facts = {"kind": "store", "holds": header.get("system", "blocks"), "bytes": nbytes}
    facts |= {"blocks": header["blocks"], "finished": _finished_blocks(path / "checksum.npy", header["blocks"])}
    return facts | {"blocks_of": {name: shape[:-1] for name, shape in header["shapes"].items()}}


def _finished_blocks(path: Path, blocks: int) -> int:
    """Number of blocks with a checksum. The file grows with the last of them, so it is short until then."""
    regular.check(path, "the checksums of a store")
    with path.open("rb") as file:
        np.lib.format.read_magic(file)
        np.lib.format.read_array_header_1_0(file)
        sums = file.read(4 * blocks)
    return int(np.count_nonzero(np.frombuffer(sums[: len(sums) // 4 * 4], np.uint32)))


def _rows(facts: JsonObject) -> Iterator[str]:
    """The description as rows of text."""
    head, *rows = {"scene": _scene_rows, "environment": _light_rows, "brdf": _brdf_rows}.get(
        facts["kind"], _folder_rows
    )(facts)
    yield f"{facts['path']}: {head}"
    rows += [f"left out: {reason}" for reason in facts.get("left_out", [])]
    rows += [row for member in facts.get("inside", []) for row in _rows(member)]
    yield from (f"  {row}" for row in rows)


def _scene_rows(facts: JsonObject) -> Iterator[str]:
    counts = "{vertices} vertices, {triangles} triangles"
    size = " x ".join(f"{high - low:.4g}" for low, high in zip(*facts["bounds"], strict=True))
    head = f"scene of {len(facts['parts'])} parts, {counts.format(**facts)}"
    yield f"{head}, {size} units, {len(facts['cameras'])} cameras"
    for number, part in enumerate(facts["parts"]):
        material = dict(part["material"])
        model = material.pop("model")
        values = ", ".join(f"{name} {_value(value)}" for name, value in material.items() if _matters(name, value))
        yield f"{number} {part['name']!r}: {counts.format(**part)}, {model}({values})"
    for number, camera in enumerate(facts["cameras"]):
        angle = f"{camera['field_of_view_degrees']:.4g}"
        yield f"camera {number}: at {_value(camera['eye'])}, {angle} degrees high"


def _matters(name: str, value: Any) -> bool:
    """Whether a parameter of a material differs from its default in glTF."""
    default = inputs.describe(TexturedMaterial())
    return name not in default or not np.array_equal(value, default[name])


def _value(value: object) -> str:
    if isinstance(value, list):
        return "/".join(map(_value, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _light_rows(facts: JsonObject) -> list[str]:
    width, height = facts["pixels"]
    least, most = facts["radiance"].values()
    shares = ", ".join(f"{n}: {100 * share:.1f} %" for n, share in facts["brightest_share"].items())
    size = facts["texels"][1]
    return [
        f"environment of {width} x {height} pixels, {facts['channels']} channels, layout {facts['layout']}",
        f"radiance from {least:.4g} to {most:.4g}, mean over the sphere {_value(facts['mean_radiance'])}",
        f"share of the light in the brightest of 6 x {size} x {size} texels: {shares}",
    ]


def _brdf_rows(facts: JsonObject) -> Iterator[str]:
    names = facts.get("materials", [])
    if facts["form"] == "scattered":
        yield f"scattered measurements, {facts['samples']} samples"
    elif names:
        some = ", ".join(names[:_NAMES]) + (", .." if len(names) > _NAMES else "")
        yield f"BRDFs ({facts['form']}) of {len(names)} materials: {some}"
    else:
        yield f"BRDF (MERL), {100 * facts['brdf']['filled']:.1f} % of its cells above the horizon filled"
    if "model" in facts:
        yield f"model: {facts['model']}"
    yield f"use: --brdf {facts['use']}"


def _folder_rows(facts: JsonObject) -> list[str]:
    size = f"{facts['bytes']:,} bytes"
    if facts["kind"] == "folder":
        return [f"folder of {len(facts['inside'])} objects and stores, {size}"]
    finished = f", {facts['finished']} of {facts['blocks']} blocks are finished" if "blocks" in facts else ""
    return [f"{facts['kind']} of {facts['holds']}, {size}{finished}"]
