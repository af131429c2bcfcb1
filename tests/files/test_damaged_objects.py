"""Saved objects that somebody has altered: each loads as a valid object or is refused as damaged."""

import copy
import dataclasses
import json
import os
import zlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import varying
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial, builtin

SEEDS = 300


@pytest.fixture(scope="module")
def objects():
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


def deep(depth):
    tree = {"value": 1}
    for _ in range(depth):
        tree = {"tuple": [tree]}
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


def use(value, objects):
    """Calls what objects of these classes are for, without compiling it."""
    eye = jnp.array([0.0, 0.0, 4.0])
    light = jnp.zeros((6, 2, 2, 3))
    if isinstance(value, Scene):
        assert len(value.mesh.face) == sum(len(part.mesh.face) for part in value.parts)
        assert [value[part.name] for part in value.parts]
    elif isinstance(value, prt.harmonic.HarmonicSystem):
        jax.eval_shape(lambda light: prt.radiance(value, Environment(light), eye=eye), light)
    elif isinstance(value, prt.harmonic.HarmonicBrdf):
        system = eqx.tree_at(lambda system: system.brdf, objects["system"], value)
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


def test_altered_objects_are_equal_or_valid_or_refused_as_damaged(objects, tmp_path):
    refused = 0
    for seed in range(SEEDS):
        random = np.random.default_rng(seed)
        name = list(objects)[seed % len(objects)]
        path = tmp_path / str(seed) / "a.prt"
        prt.files.save(path, objects[name])
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
        elif not equal(loaded, objects[name]):
            use(loaded, objects)
    assert refused > SEEDS / 2


ABSTRACT = {"algorithm": {"jaxprt.systems.protocol": 1}}
CASES = {
    "null in place of an array": (
        "mesh",
        lambda content: content["tree"]["field"].update(position={"value": None}),
        r"position of Mesh must be an array Float\[v 3\], got None",
    ),
    "arrays exchanged": (
        "mesh",
        lambda content: content["tree"]["field"].update(face=content["tree"]["field"]["position"]),
        r"face of Mesh must be an array Int\[f 3\], got an array of float32 \[\d+, 3\]",
    ),
    "a class of another kind": (
        "scene",
        lambda content: content["tree"]["field"]["cameras"]["tuple"].append(
            content["tree"]["field"]["environments"]["tuple"][0]
        ),
        "cameras of Scene must be a tuple of Camera, ..., got a tuple",
    ),
    "a check of the class": (
        "scene",
        lambda content: content["tree"]["field"]["cameras"]["tuple"][0]["field"].update(width={"value": 0}),
        "width must be a whole number of pixels, at least 1, got 0",
    ),
    "a static field of another type": (
        "scene",
        lambda content: content["tree"]["field"]["parts"]["tuple"][0]["field"].update(name={"value": 3}),
        "name of Part must be str, got 3",
    ),
    "other numbers of vertices": (
        "system",
        lambda content: content["tree"]["field"]["transport"]["field"].update(
            position={"array": number_of(content, [3, 3]), "kind": "jax"}
        ),
        r"its arrays must be from|frame of TransferMatrix|position of TransferMatrix",
    ),
    "nested too deeply": ("mixed", lambda content: content.update(tree=deep(10_000)), "nested too deeply"),
    "an array beyond the table": (
        "mixed",
        lambda content: content["tree"]["dict"].update(b={"array": 7, "kind": "numpy"}),
        "its arrays must be from 0 to 1, got 'numpy' array 7",
    ),
    "an array by a path": (
        "mixed",
        lambda content: content["tree"]["dict"].update(b={"array": "../../secret", "kind": "numpy"}),
        "array of its description must be a int, got a str",
    ),
    "no algorithm": (
        "brdf",
        lambda content: content.update(algorithm={}),
        "must state the algorithm of jaxprt.systems.harmonic.table",
    ),
    "an array of objects": (
        "mixed",
        lambda content: content["array"][0].update(dtype="object"),
        "array 0 of object .* cannot be read: it is not of numbers",
    ),
    "a negative shape": (
        "mixed",
        lambda content: content["array"][0].update(shape=[-3]),
        "must have a shape of whole numbers",
    ),
    "a huge shape": (
        "mixed",
        lambda content: content["array"][0].update(shape=[2**62, 2**62]),
        "array 0 of int64 .* cannot be read",
    ),
    "an abstract class": (
        "mixed",
        lambda content: content | {"tree": {"class": "jaxprt.systems.protocol:System", "field": {}}} | ABSTRACT,
        "abstract class|does not have",
    ),
}


def number_of(content, shape):
    """Number of an array of some shape; one that no table has if there is none."""
    shapes = [entry["shape"] for entry in content["array"]]
    return shapes.index(shape) if shape in shapes else 10**6


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_told(case, objects, tmp_path):
    name, alter, message = CASES[case]
    path = tmp_path / "a.prt"
    prt.files.save(path, objects[name])
    if case == "nested too deeply":  # deeper than `json.dumps` can write
        rewrite(path, lambda content: content.update(tree="HERE"))
        header = json.loads((path / "object.json").read_text())
        text = header["content"].replace('"HERE"', '{"tuple": [' * 10_000 + "]}" * 10_000)
        header |= {"content": text, "checksum": zlib.crc32(text.encode())}
        (path / "object.json").write_text(json.dumps(header))
    else:
        rewrite(path, alter)
    with pytest.raises(ValueError, match=rf"a\.prt is damaged.*({message})|a\.prt names.*({message}).*damaged"):
        prt.files.load(path)


def test_pipes_and_links_in_place_of_files_are_refused_and_nothing_outside_is_read(objects, tmp_path):
    secret = tmp_path / "secret.npy"
    for kind, make in (("special file", os.mkfifo), ("link", lambda file: file.symlink_to(secret))):
        for name in ("0.npy", "object.json"):
            path = tmp_path / f"{kind} {name}.prt"
            prt.files.save(path, objects["mesh"])
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
