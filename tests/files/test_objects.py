"""Objects that are saved, loaded and pickled: every class of the package, without loss, and what is refused.

Saved objects that somebody has altered: each loads as a valid object or is refused as damaged.
"""

import copy
import dataclasses
import importlib
import inspect
import itertools
import json
import os
import pickle
import pkgutil
import types
import typing
import zlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import navigation, varying
from jaxprt.files import arrays, objects
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial, builtin
from jaxprt.sensors.bases import Basis
from jaxprt.sphere import hemisphere

# Host records of the command line, of reports, of files that are read, and libraries; no user saves them.
UNSAVED = {"jaxprt.cli.report", "jaxprt.cli.animation", "jaxprt.__main__", "jaxprt.view.piece", "jaxprt.view.messages"}
UNSAVED |= {
    f"jaxprt.scene.formats.{name}" for name in ("geometry", "gltf_file", "gltf_geometry", "gltf_nodes", "ply", "text")
}
UNSAVED |= {"jaxprt.visibility.embree", "jaxprt.relit.exact_lamps"}
SEEDS = 150


def classes():
    """All public classes of the package that hold data."""
    for info in pkgutil.walk_packages(prt.__path__, "jaxprt."):
        if info.name in UNSAVED:
            continue
        for name, kind in inspect.getmembers(importlib.import_module(info.name), inspect.isclass):
            data = issubclass(kind, eqx.Module) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))
            public = kind.__module__ == info.name and not name.startswith("_")
            if data and public and not inspect.isabstract(kind):
                yield kind


def filled(kind, random, within=()):
    """An instance, each field of which holds something of its type; nothing is converted or checked.

    What may hold another of its own kind does so once.
    """
    within = (*within, kind)
    hint = typing.get_type_hints(kind)
    if not issubclass(kind, eqx.Module):
        return kind(*(value(hint[name], random, within=within) for name in kind._fields))
    result = object.__new__(kind)
    for field in dataclasses.fields(kind):
        object.__setattr__(result, field.name, value(hint[field.name], random, field.name, within))
    return result


def shape(axes):
    """A shape with some axes: two entries along an axis with a name, none for axes of any number."""
    words = [word for word in axes.split() if "*" not in word and word != "..."]
    return [int(word) if word.isdigit() else 2 for word in words]


def value(hint, random, name="", within=()):
    """Something of a type."""
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return None if within.count(arguments[0]) > 1 else value(arguments[0], random, name, within)
    if typing.get_origin(hint) is tuple:
        each = arguments[:1] * 2 if arguments[-1] is ... else arguments
        return tuple(value(one, random, within=within) for one in each)
    if typing.get_origin(hint) is dict:
        return {}
    if hasattr(hint, "dtypes"):
        dtype = jnp.dtype(
            next(one for one in hint.dtypes if one not in ("float8_e4m3b11fnuz", "bfloat16", "int2", "uint2"))
        )
        array = random.integers(0, 2, shape(hint.dim_str)).astype(dtype)
        return array if hint.array_type is np.ndarray else jnp.asarray(array)
    plain = {
        bool: True,
        int: 3,
        float: 0.1,
        str: "name",
        np.ndarray: np.arange(3),
        typing.Any: {"a": [1.5, None, (True,)]},
        dict: {"a": 1},
    }
    if hint in plain:
        return plain[hint]
    if hint in (prt.System, prt.systems.protocol.VertexSystem):
        hint = prt.harmonic.DiffuseSystem  # Any system will do.
    if hint is Basis:
        hint = prt.sensors.Patches
    if hint is prt.systems.standard.StandardTable:
        return prt.systems.standard.METALLIC_ROUGHNESS
    if inspect.isclass(hint) and hint.__module__.startswith("jaxprt"):
        return filled(hint, random, within)
    return {"coordinates": hemisphere.polar_coordinates, "chart": navigation._log_roughness}.get(
        name, prt.brdf.Lambert()
    )


def same(one, other):
    """Asserts equal structure, types and bits."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert type(one) is type(other)
    for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert type(first) is type(second)
        assert np.asarray(first).dtype == np.asarray(second).dtype
        assert np.asarray(first).shape == np.asarray(second).shape
        assert np.asarray(first).tobytes() == np.asarray(second).tobytes()


def test_every_class_of_the_package_is_the_same_after_saving_and_after_pickling(tmp_path, monkeypatch):
    monkeypatch.setattr(objects, "_run_checks", lambda value: None)  # which relate the values of fields
    random = np.random.default_rng(0)
    every = {f"{kind.__module__}.{kind.__name__}": filled(kind, random) for kind in classes()}
    for name in ("SeparableBrdf", "DynamicBrdf", "TransferTensor", "DynamicTransport", "Plan", "Environment", "Camera"):
        assert [key for key in every if key.endswith(f".{name}")], name
    prt.files.save(tmp_path / "all.prt", every)
    again = prt.files.load(tmp_path / "all.prt")
    assert list(again) == list(every)
    for name, one in every.items():
        same(again[name], one)
        same(pickle.loads(pickle.dumps(one)), one)


def test_numbers_of_every_type_and_shape_keep_their_bits(tmp_path):
    types = ["bool", "int8", "uint8", "uint16", "int32", "uint32", "float16", "bfloat16", "float32", "complex64"]
    random = np.random.default_rng(0)
    arrays = {name: jnp.asarray(random.normal(size=(3, 2)) > 0).astype(name) for name in types}
    arrays["half"] = jnp.asarray(random.normal(size=(2, 5)), jnp.bfloat16)
    arrays["special"] = jnp.array([jnp.nan, -0.0, jnp.inf, 1e-45])
    arrays |= {"empty": jnp.zeros((0, 4)), "none": jnp.zeros((3, 0), jnp.float16), "number": jnp.float32(2)}
    host = {"wide": random.normal(size=4), "turned": random.normal(size=(3, 4)).T, "scalar": np.float64(0.1)}
    plain = {"float": 0.1, "nan": float("nan"), "large": 1 << 80, "text": "ä", "none": None, "both": (True, [1])}
    everything = {"arrays": arrays, "host": host, "plain": plain}
    prt.files.save(tmp_path / "deep" / "a.prt", everything)
    again = prt.files.load(tmp_path / "deep" / "a.prt")
    same((again["arrays"], again["host"]), (arrays, host))
    assert repr(again["plain"]) == repr(plain)
    assert not [file for file in tmp_path.rglob("*") if file.suffix in (".pkl", ".pickle", ".new")]


def test_arrays_that_two_fields_share_are_saved_once_and_shared_again(tmp_path):
    whole = jnp.arange(4.0)
    prt.files.save(tmp_path / "a.prt", {"one": whole, "other": (whole, np.arange(3))})
    again = prt.files.load(tmp_path / "a.prt")
    assert again["one"] is again["other"][0]
    assert len(list((tmp_path / "a.prt").glob("*.npy"))) == 2


LINE, DIFFUSE = navigation.Line(jnp.arange(2.0)), jnp.zeros((1, 3))


class Foreign(eqx.Module):
    """A BRDF of somebody else."""

    albedo: float = 0.5


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (
            navigation.Family((lambda wi, wo: wi,), LINE, ("a",), DIFFUSE, DIFFUSE),
            r"Family\.brdf\[0\].*got the function",
        ),
        ({"a": (1, Foreign())}, r"dict\['a'\]\[1\] must be an object of jaxprt.*got a Foreign"),
        (eqx.filter_jit(lambda x: x), "must be an object of jaxprt"),
        (np.array(["text"]), "must be an array of numbers"),
        (jax.random.key(0), "must be an array of numbers"),
        ({1: 2}, "must be an object of jaxprt.*got a dict"),
    ],
)
def test_what_is_no_data_of_the_package_is_refused_by_its_place_and_leaves_no_file(wrong, told, tmp_path, unchecked):
    with pytest.raises(TypeError, match=told):
        prt.files.save(tmp_path / "a.prt", wrong)
    assert not list(tmp_path.iterdir())


def test_values_that_are_being_traced_are_refused(tmp_path):
    with pytest.raises(TypeError, match="got one that JAX is tracing"):
        jax.jit(lambda x: prt.files.save(tmp_path / "a.prt", x))(jnp.zeros(3))


def test_nothing_is_replaced_and_a_save_that_fails_leaves_nothing(tmp_path, monkeypatch):
    path = tmp_path / "a.prt"
    prt.files.save(path, 1)
    with pytest.raises(FileExistsError, match=r"a\.prt exists; remove it or name another path"):
        prt.files.save(path, 2)
    assert prt.files.load(path) == 1
    other = tmp_path / "b.prt"

    def full(*_, **__):
        assert not other.exists()
        raise OSError("no space left on device")

    monkeypatch.setattr(arrays, "write_header", full)
    with pytest.raises(OSError, match="no space"):
        prt.files.save(other, jnp.zeros(3))
    assert [file.name for file in tmp_path.iterdir()] == ["a.prt"]


def rewritten(path, **change):
    """Changes what the header says, its checksum made to fit."""
    content = json.loads(json.loads((path / "object.json").read_text())["content"])
    for place, new in change.items():
        content[place] = new
    text = json.dumps(content)
    headed(path, content=text, checksum=zlib.crc32(text.encode()))


def headed(path, **change):
    """Changes the header."""
    header = json.loads((path / "object.json").read_text())
    (path / "object.json").write_text(json.dumps(header | change))


def test_damage_is_found_and_told(tmp_path, samples):
    number = itertools.count()

    def saved():
        path = tmp_path / f"{next(number)}.prt"
        prt.files.save(path, samples["brdf"])
        return path

    path = saved()
    file = path / "0.npy"
    content = file.read_bytes()
    for damaged in (content[:9], content[:-1] + bytes([content[-1] ^ 1])):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"0\.prt is damaged: array 0 of float32"):
            prt.files.load(path)
    file.unlink()
    with pytest.raises(ValueError, match="is damaged"):
        prt.files.load(path)
    path = saved()
    headed(path, content="{}")
    with pytest.raises(ValueError, match="is damaged: its description"):
        prt.files.load(path)
    (path / "object.json").write_text("{")
    with pytest.raises(ValueError, match="wrote, got one that cannot be read"):
        prt.files.load(path)
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        prt.files.load(tmp_path / "missing")
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        prt.files.load(tmp_path / ("a" * 300))
    (tmp_path / "other").mkdir()
    with pytest.raises(ValueError, match="got another kind of file or folder"):
        prt.files.load(tmp_path / "other")


def test_other_versions_of_the_format_the_algorithm_or_a_class_are_refused(tmp_path, samples, monkeypatch):
    path = tmp_path / "a.prt"
    prt.files.save(path, samples["brdf"])
    monkeypatch.setattr(prt.harmonic.table, "ALGORITHM", 77, raising=False)
    with pytest.raises(ValueError, match=r"algorithm in jaxprt.systems.harmonic.table, this jaxprt has version 77"):
        prt.files.load(path)
    monkeypatch.undo()
    for version, cure in ((99, "update jaxprt"), (2, "precompute and save it anew, or load it with")):
        headed(path, version=version)
        with pytest.raises(ValueError, match=f"must have format version 3, got {version}: {cure}"):
            prt.files.load(path)
    headed(path, version=3)
    rewritten(path, tree={"class": "jaxprt.scene.environment:Environment", "field": {"light": {"value": 1}}})
    with pytest.raises(ValueError, match="with the fields light, this jaxprt's has radiance"):
        prt.files.load(path)


@pytest.mark.parametrize(
    "tree",
    [
        {"class": "os:system", "field": {}},
        {"class": "jaxprt.files.objects:Path", "field": {}},
        {"class": "jaxprt.files.objects:os", "field": {}},
        {"class": "jaxprt.__main__:main", "field": {}},
        {"class": "jaxprt.nothing:Mesh", "field": {}},
        {"class": "jaxprt.visibility.rays:Occluder", "field": {}},
        {"class": "jaxprt.brdf:Lambert", "field": {}},
        {"function": "os:system"},
        {"function": "jaxprt.sphere.hemisphere:arcs"},
    ],
)
def test_a_file_can_name_no_class_or_function_but_those_that_hold_data_of_the_package(tmp_path, tree):
    path = tmp_path / "a.prt"
    prt.files.save(path, 1)
    rewritten(path, tree=tree)
    with pytest.raises(ValueError, match=r"a\.prt names the (class|module|function)"):
        prt.files.load(path)


def test_numbers_of_64_bits_are_loaded_with_x64_and_refused_without(tmp_path):
    with jax.enable_x64(True):
        light = prt.scene.Environment(jnp.full((6, 2, 2, 3), 0.1, jnp.float64))
        prt.files.save(tmp_path / "a.prt", light)
        same(prt.files.load(tmp_path / "a.prt"), light)
    with pytest.raises(ValueError, match="holds arrays of float64, which JAX has only with jax_enable_x64"):
        prt.files.load(tmp_path / "a.prt")


def test_arrays_of_devices_are_maps_of_their_files_on_cpus_and_those_of_the_host_are_not(tmp_path):
    both = jnp.arange(4096.0), np.arange(4096.0)
    prt.files.save(tmp_path / "a.prt", both)
    device, host = prt.files.load(tmp_path / "a.prt")
    there = arrays.reference(np.asarray(device))
    assert isinstance(there, arrays.Reference)
    assert there.path == str(tmp_path / "a.prt" / "0.npy")
    host[0] = 7
    same(prt.files.load(tmp_path / "a.prt"), both)


def test_objects_that_zarr_saved_are_refused_by_their_version(tmp_path):
    header = {"zarr_format": 3, "attributes": {"format": "jaxprt object", "version": 1, "content": "{}"}}
    (tmp_path / "zarr.json").write_text(json.dumps(header))
    with pytest.raises(ValueError, match="must have format version 3, got 1: precompute and save it anew"):
        prt.files.load(tmp_path)


@pytest.fixture(scope="module")
def samples():
    """Small objects of several classes, by name."""
    random = np.random.default_rng(0)
    mesh = builtin.sphere(rings=3, sectors=4)
    mesh = dataclasses.replace(mesh, texture=jnp.asarray(random.uniform(size=(len(mesh.position), 2)), jnp.float32))
    image = jnp.asarray(random.uniform(size=(4, 4, 3)), jnp.float32)
    paint = TexturedMaterial(base_color_texture=Texture(image), metallic=0.0)
    camera = Camera([2.0, 1.5, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.7, 8, 8)
    light = Environment(random.uniform(size=(6, 2, 2, 3)))
    table = jnp.asarray(random.uniform(size=(9, 1, 4, 4)), jnp.float32)
    brdf = prt.harmonic.HarmonicBrdf(table, (), jnp.float32(0.1))
    count = len(mesh.position)
    frame = jnp.broadcast_to(jnp.eye(3), (count, 3, 3))
    matrix = jnp.asarray(random.normal(size=(count, 1, 9, 9)), jnp.float32)
    transport = prt.harmonic.TransferMatrix(matrix, mesh.position, frame)
    return {
        "mesh": mesh,
        "scene": Scene([Part("ball", mesh, paint), Part("other", mesh, prt.brdf.GGX(f0=0.5))], [camera], [light]),
        "brdf": brdf,
        "system": prt.harmonic.HarmonicSystem(transport, brdf),
        "mixed": {"a": (1, 0.5, "text", None), "b": [np.arange(3), np.float64(2)]},
    }


def nodes(tree, place=()):
    """All places in nested lists and dictionaries."""
    yield place
    if isinstance(tree, dict | list):
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            yield from nodes(tree[key], (*place, key))


def at(tree, place):
    for key in place:
        tree = tree[key]
    return tree


WRONG = (None, True, -1, 0, 10**400, 1.5, float("nan"), "", "text", "../../secret", [], {}, [[]], {"value": 1})
WRONG += ({"array": 0, "kind": "jax"}, {"array": -1, "kind": "jax"}, {"array": 0, "kind": "other"}, {"tuple": []})
WRONG += ({"array": "../../secret", "kind": "numpy"}, {"class": "os:system", "field": {}}, {"function": "os:system"})
WRONG += ({"value": [1]}, {"value": 1, "tuple": []}, {"class": "jaxprt.brdf.models:Lambert", "field": {}})


def alter_description(content, random):
    """Replaces, removes, renames or exchanges something in a description."""
    places = [place for place in nodes(content) if place]
    place = places[random.integers(len(places))]
    holder, key = at(content, place[:-1]), place[-1]
    kind = random.integers(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[f"{key}_"] = holder.pop(key)
    elif kind == 2:
        other = places[random.integers(len(places))]
        holder[key] = copy.deepcopy(at(content, other))
    elif kind == 3 and isinstance(holder, dict):
        holder["extra"] = {"value": 1}
    elif kind == 4:
        arrays = [spot for spot in places if spot[-1] == "array" and isinstance(at(content, spot), int)]
        first, second = (arrays[random.integers(len(arrays))] for _ in range(2))
        one, two = at(content, first), at(content, second)
        at(content, first[:-1])["array"], at(content, second[:-1])["array"] = two, one
    else:
        holder[key] = copy.deepcopy(WRONG[random.integers(len(WRONG))])


def alter_table(content, path, random):
    """Writes another array in place of one, and describes it rightly."""
    number = random.integers(len(content["array"]))
    entry = content["array"][number]
    shapes = [entry["shape"], entry["shape"][::-1], [*entry["shape"], 1], entry["shape"][:-1], [0], [2, 0]]
    shape = shapes[random.integers(len(shapes))]
    dtype = ["float32", "int32", "uint8", "bool", "float16", "complex64"][random.integers(6)]
    value = random.integers(-2, 300, shape).astype(dtype)
    np.save(path / f"{number}.npy", value)
    checksum = zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    content["array"][number] = {"dtype": dtype, "shape": shape, "checksum": checksum}


def alter_file(path, random):
    """Damages one of the files."""
    files = sorted(path.iterdir())
    file = files[random.integers(len(files))]
    data = file.read_bytes()
    kind = random.integers(7)
    if kind == 0:
        file.write_bytes(data[: random.integers(len(data))])
    elif kind == 1:
        spot = random.integers(len(data))
        file.write_bytes(data[:spot] + bytes([data[spot] ^ (1 << random.integers(8))]) + data[spot + 1 :])
    elif kind == 2:
        file.unlink()
    elif kind == 3:
        file.unlink()
        os.mkfifo(file)
    elif kind == 4:
        outside = path.parent / "outside.npy"
        outside.write_bytes(data)
        file.unlink()
        file.symlink_to(outside)
    elif kind == 5:
        np.save(file, np.array([{"an": "object"}], object), allow_pickle=True)
        if file.suffix != ".npy":
            file.unlink()
            os.replace(f"{file}.npy", file)
    else:
        file.write_bytes(b"")


def rewrite(path, alter):
    """Changes the description of a saved object, with a right checksum."""
    header = json.loads((path / "object.json").read_text())
    content = json.loads(header["content"])
    content = alter(content) or content
    header["content"] = json.dumps(content)
    header["checksum"] = zlib.crc32(header["content"].encode())
    (path / "object.json").write_text(json.dumps(header))


def use(value, samples):
    """Calls what objects of these classes are for, without compiling it."""
    eye = jnp.array([0.0, 0.0, 4.0])
    light = jnp.zeros((6, 2, 2, 3))
    if isinstance(value, Scene):
        assert len(value.mesh.face) == sum(len(part.mesh.face) for part in value.parts)
        assert [value[part.name] for part in value.parts]
    elif isinstance(value, prt.harmonic.HarmonicSystem):
        jax.eval_shape(lambda light: prt.radiance(value, Environment(light), eye=eye), light)
    elif isinstance(value, prt.harmonic.HarmonicBrdf):
        system = eqx.tree_at(lambda system: system.brdf, samples["system"], value)
        if value.degree == system.degree and not value.knot:
            jax.eval_shape(lambda light: prt.radiance(system, Environment(light), eye=eye), light)


def attempt(path):
    """The loaded object, or the message of an error; other errors than those that are documented pass."""
    try:
        return prt.files.load(path), None
    except (ValueError, FileNotFoundError) as error:
        return None, str(error)


def equal(one, other):
    return bool(eqx.tree_equal(one, other))


def test_altered_objects_are_equal_or_valid_or_refused_as_damaged(samples, tmp_path):
    refused = 0
    for seed in range(SEEDS):
        random = np.random.default_rng(seed)
        name = list(samples)[seed % len(samples)]
        path = tmp_path / str(seed) / "a.prt"
        prt.files.save(path, samples[name])
        way = random.integers(5)
        if way < 3:
            rewrite(path, lambda content, random=random: alter_description(content, random))
        elif way == 3:
            rewrite(path, lambda content, random=random, path=path: alter_table(content, path, random))
        else:
            alter_file(path, random)
        loaded, error = attempt(path)
        if error is not None:
            assert "damaged" in error, (seed, error)
            assert str(path) in error, (seed, error)
            refused += 1
        elif not equal(loaded, samples[name]):
            use(loaded, samples)
    assert refused > SEEDS / 2


def in_scene(content, name):
    return content["tree"]["field"][name]["tuple"]


def field(content, name, value):
    content["tree"]["field"][name] = value


def entry(content, name, value):
    content["tree"]["dict"][name] = value


ABSTRACT = {"class": "jaxprt.systems.protocol:System", "field": {}}
CASES = {
    r"position of Mesh must be an array Float\[v 3\], got None": (
        "mesh",
        lambda content: field(content, "position", {"value": None}),
    ),
    r"face of Mesh must be an array Int\[f 3\], got an array of float32 \[\d+, 3\]": (
        "mesh",
        lambda content: field(content, "face", content["tree"]["field"]["position"]),
    ),
    "cameras of Scene must be a tuple of Camera, ..., got a tuple": (
        "scene",
        lambda content: in_scene(content, "cameras").append(in_scene(content, "environments")[0]),
    ),
    "width must be a whole number of pixels, at least 1, got 0": (
        "scene",
        lambda content: in_scene(content, "cameras")[0]["field"].update(width={"value": 0}),
    ),
    r"its arrays must be from|frame of TransferMatrix|position of TransferMatrix": (
        "system",
        lambda content: content["tree"]["field"]["transport"]["field"].update(
            position={"array": number_of(content, [3, 3]), "kind": "jax"}
        ),
    ),
    "nested too deeply": ("mixed", lambda content: content.update(tree="HERE")),
    "its arrays must be from 0 to 1, got 'numpy' array 7": (
        "mixed",
        lambda content: entry(content, "b", {"array": 7, "kind": "numpy"}),
    ),
    "array of its description must be a int, got a str": (
        "mixed",
        lambda content: entry(content, "b", {"array": "../../secret", "kind": "numpy"}),
    ),
    "must state the algorithm of jaxprt.systems.harmonic.table": ("brdf", lambda content: content.update(algorithm={})),
    "array 0 of object .* cannot be read: it is not of numbers": (
        "mixed",
        lambda content: content["array"][0].update(dtype="object"),
    ),
    "array 0 of int64 .* cannot be read": ("mixed", lambda content: content["array"][0].update(shape=[2**62, 2**62])),
    "abstract class|does not have": (
        "mixed",
        lambda content: content | {"tree": ABSTRACT, "algorithm": {"jaxprt.systems.protocol": 1}},
    ),
}


def number_of(content, shape):
    """Number of an array of some shape; one that no table has if there is none."""
    shapes = [entry["shape"] for entry in content["array"]]
    return shapes.index(shape) if shape in shapes else 10**6


@pytest.mark.parametrize("message", CASES)
def test_what_is_wrong_is_told(message, samples, tmp_path):
    name, alter = CASES[message]
    path = tmp_path / "a.prt"
    prt.files.save(path, samples[name])
    rewrite(path, alter)
    if message == "nested too deeply":  # deeper than `json.dumps` can write
        header = json.loads((path / "object.json").read_text())
        text = header["content"].replace('"HERE"', '{"tuple": [' * 10_000 + "]}" * 10_000)
        (path / "object.json").write_text(json.dumps(header | {"content": text, "checksum": zlib.crc32(text.encode())}))
    with pytest.raises(ValueError, match=rf"a\.prt is damaged.*({message})|a\.prt names.*({message}).*damaged"):
        prt.files.load(path)


def test_pipes_and_links_in_place_of_files_are_refused_and_nothing_outside_is_read(samples, tmp_path):
    secret = tmp_path / "secret.npy"
    for kind, make in (("special file", os.mkfifo), ("link", lambda file: file.symlink_to(secret))):
        for name in ("0.npy", "object.json"):
            path = tmp_path / f"{kind} {name}.prt"
            prt.files.save(path, samples["mesh"])
            secret.write_bytes((path / name).read_bytes())  # content that would pass
            (path / name).unlink()
            make(path / name)
            with pytest.raises(ValueError, match=rf"damaged.*got a {kind}"):
                prt.files.load(path)


def test_what_loading_would_refuse_is_refused_when_it_is_saved(tmp_path):
    wrong = eqx.tree_at(lambda brdf: brdf.albedo, prt.brdf.Lambert(0.5), jnp.array([-0.5]))
    with pytest.raises(TypeError, match=r"dict\['a'\] must be a valid Lambert .* albedo of Lambert must be at least 0"):
        prt.files.save(tmp_path / "a.prt", {"a": wrong})
    wrong = eqx.tree_at(lambda brdf: brdf.albedo, prt.brdf.Lambert(0.5), jnp.ones((2, 3)))
    with pytest.raises(TypeError, match=r"albedo of Lambert must be an array Float\[c\], got .* \[2, 3\]"):
        prt.files.save(tmp_path / "a.prt", wrong)
    assert not list(tmp_path.iterdir())


def test_models_that_vary_over_vertices_or_a_set_keep_their_leading_axes(tmp_path):
    model = eqx.tree_at(lambda brdf: brdf.albedo, prt.brdf.Lambert(0.5), jnp.full((7, 3), 0.25))
    prt.files.save(tmp_path / "a.prt", varying.PerVertex(model))
    assert equal(prt.files.load(tmp_path / "a.prt"), varying.PerVertex(model))
