"""Animations and morph targets of glTF files, against three.js (`peers/three_poses.mjs`) and SciPy."""

import json
import pathlib
import warnings

import numpy as np
import pytest
import scipy.interpolate
import scipy.spatial

from jaxprt.scene import load_scene
from jaxprt.scene.formats import gltf_nodes
from tests.scene.formats.gltf_writer import PLACE, SQUARE, Writer, one

POSES = json.loads((pathlib.Path(__file__).parent / "peers/three_poses.json").read_text())
UNNORMALIZED = 5e-4  # SimpleSkin's quaternions have three digits: jaxprt scales them to length 1, three.js does not
KEYS = np.float32([0.25, 1, 2])
TURNS = np.float32([[0, 0, 0, 1], [0.6, 0, 0, 0.8], [0, -0.8, 0, -0.6]])


def moving() -> Writer:
    """A square in a node that moves and grows, below one that turns; beside a square whose morph targets move.

    The translation is a cubic spline, the rotation linear and in normalized integers, the scale in steps, the weights a
    cubic spline. One morph target is sparse.
    """
    writer = Writer()
    one(writer.square(), writer=writer)
    rng = np.random.default_rng(0)
    index, value = writer.view(np.array([1, 3], np.uint8).tobytes()), writer.view(SQUARE[1:3].tobytes())
    parts = {"count": 2, "indices": {"bufferView": index, "componentType": 5121}, "values": {"bufferView": value}}
    sparse = writer.add("accessors", {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": parts})
    full = writer.accessor(rng.normal(size=(4, 3)))
    one(writer.square() | {"targets": [{"POSITION": sparse}, {"POSITION": full}]}, writer=writer)
    writer.header["nodes"] = [
        {"children": [1], "scale": [1, 2, 1]},
        {"mesh": 0, "translation": [1, 2, 3]},
        {"mesh": 1, "translation": [5, 0, 0], "weights": [0.5, 0]},
    ]
    writer.header["scenes"] = [{"nodes": [0, 2]}]
    time = writer.accessor(KEYS)
    outputs = {
        "translation": (1, "CUBICSPLINE", writer.accessor(rng.normal(size=(9, 3)))),
        "rotation": (0, "LINEAR", writer.accessor(np.int16(np.round(TURNS * 32767)), normalized=True)),
        "scale": (1, "STEP", writer.accessor(rng.uniform(1, 2, (3, 3)))),
        "weights": (2, "CUBICSPLINE", writer.accessor(rng.normal(size=18))),
    }
    samplers = [{"input": time, "output": output, "interpolation": kind} for _, kind, output in outputs.values()]
    targets = [{"node": node, "path": path} for path, (node, *_) in outputs.items()]
    channels = [{"sampler": number, "target": target} for number, target in enumerate(targets)]
    writer.header["animations"] = [{"name": "all", "samplers": samplers, "channels": channels}]
    return writer


def position(path, **options) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(load_scene(path, **options).mesh.position)


@pytest.mark.parametrize("name", [name for name in POSES if name != "lit.glb"])
def test_vertices_are_where_three_js_has_them(data, tmp_path, name):
    path = moving().write(tmp_path / "moving.glb") if name == "moving.glb" else data / "foreign" / name
    assert {"rest"} < POSES[name].keys() or name == "alien.glb"
    for pose, peer in POSES[name].items():
        animation, _, seconds = pose.rpartition("@")
        ours = position(path, **({} if pose == "rest" else {"time": float(seconds), "animation": animation or None}))
        bound = (UNNORMALIZED if name == "SimpleSkin.gltf" else 1e-5) * np.ptp(ours, axis=0).max()
        assert scipy.spatial.KDTree(ours).query(peer["some"])[0].max() < bound, pose
        if name != "SimpleSkin.gltf":  # whose vertices are repeated, because it has no normals
            assert len(ours) == peer["count"]
            np.testing.assert_allclose(ours.mean(0), peer["mean"], atol=bound, err_msg=pose)


def test_interpolation_is_that_of_scipy():
    rng = np.random.default_rng(1)
    before, after = rng.normal(size=(2, 3, 1, 4))
    spline = scipy.interpolate.CubicHermiteSpline([0, 0.7], [before[1], after[1]], [before[2], after[0]])
    start, end = rng.normal(size=(2, 4))
    end = -end if start @ end > 0 else end  # so that the shorter way is the other one
    rotations = scipy.spatial.transform.Rotation.from_quat([start, end])
    for along in (0.0, 0.2, 0.9, 1.0):
        np.testing.assert_allclose(
            gltf_nodes._hermite([*before], [*after], 0.7, along), spline(0.7 * along), atol=1e-12
        )
        turn = scipy.spatial.transform.Slerp([0, 1], rotations)(along).as_quat()
        ours = gltf_nodes.slerp(start, end, along)
        np.testing.assert_allclose(ours * np.sign(ours @ turn), turn, atol=1e-12)
    np.testing.assert_allclose(gltf_nodes.slerp(start, 2 * start, 0.3), start / np.linalg.norm(start), atol=1e-12)


def test_times_outside_of_the_keys_show_the_ends_and_one_key_is_enough(tmp_path):
    writer = moving()
    path = writer.write(tmp_path / "a.glb")
    np.testing.assert_array_equal(position(path, time=0), position(path, time=0.25))
    np.testing.assert_array_equal(position(path, time=99, animation="all"), position(path, time=2, animation=0))
    writer.header["animations"] = [{"samplers": [{"input": 0, "output": 1}], "channels": []}]
    once, shift = writer.accessor(np.float32([3])), writer.accessor(np.float32([[7, 8, 9]]))
    writer.header["animations"] = [
        {
            "samplers": [{"input": once, "output": shift}],
            "channels": [{"sampler": 0, "target": {"node": 2, "path": "translation"}}],
        }
    ]
    ours = position(writer.write(tmp_path / "a.glb"), time=1)
    np.testing.assert_allclose(ours[4:] - position(path)[4:], [[2, 8, 9]] * 4, atol=1e-6)


def morphed(writer: Writer, **attribute) -> dict:
    """A primitive with two morph targets: the second tilts the square about x and colors it."""
    plain = np.zeros((4, 3), np.float32)
    targets = [{"POSITION": plain + 50}, {"POSITION": SQUARE[:, [2, 2, 1]] - [[0, 0.5, 0]] * SQUARE[:, [1]]}]
    targets[1] |= {"NORMAL": plain + [0, -1, 0], "TANGENT": plain, "COLOR_0": plain - [0, 0.25, 2]}
    targets[1] |= {"TEXCOORD_0": PLACE}
    made = [{key: writer.accessor(np.float32(value)) for key, value in target.items()} for target in targets]
    return writer.square(COLOR_0=plain + 1, TEXCOORD_0=PLACE, **attribute) | {"targets": made}


def test_morph_targets_have_the_weights_of_their_node_or_else_of_their_mesh(tmp_path):
    writer = Writer()
    one(morphed(writer), writer=writer)
    writer.header["meshes"][0]["weights"] = [0, 1]
    writer.header["nodes"] = [{"mesh": 0, "translation": [0, 0, 9]}, {"mesh": 0, "weights": [0, 0]}]
    writer.header["scenes"][0]["nodes"] = [0, 1]
    (part,) = load_scene(writer.write(tmp_path / "a.glb")).parts
    tilted = SQUARE * [1, 0.5, 1] + SQUARE[:, [2, 2, 1]] + [0, 0, 9]
    np.testing.assert_allclose(part.mesh.position, np.concatenate([tilted, SQUARE]), atol=1e-6)
    np.testing.assert_allclose(part.mesh.normal[:4], [[0, -(0.5**0.5), 0.5**0.5]] * 4, atol=1e-6)
    np.testing.assert_allclose(part.color, [[1, 0.75, 0]] * 4 + [[1, 1, 1]] * 4, atol=1e-6)
    flipped = PLACE * [1, -1] + [0, 1]
    np.testing.assert_allclose(part.mesh.texture[:4], PLACE * [2, -2] + [0, 1], atol=1e-6)
    np.testing.assert_allclose(part.mesh.texture[4:], flipped, atol=1e-6)


def test_flat_normals_are_those_of_morphed_triangles(tmp_path):
    writer = Writer()
    one(morphed(writer, NORMAL=None), writer=writer)
    writer.header["meshes"][0]["weights"] = [0, 1]
    mesh = load_scene(writer.write(tmp_path / "a.glb")).mesh
    np.testing.assert_allclose(mesh.normal, [[0, -(0.8**0.5), 0.2**0.5]] * 6, atol=1e-6)


def channel(header, number, **change):
    header["animations"][0]["channels"][number].update(change)


def sampler(header, number, **change):
    header["animations"][0]["samplers"][number].update(change)


def targets(header):
    return header["meshes"][1]["primitives"][0]["targets"]


DAMAGE = {
    r"animation 0, got none|must have animations where a time is given, got none": lambda h: h.pop("animations"),
    r"must refer to one of its 4 samplers in channel 0 of animation 0, got 4": lambda h: channel(h, 0, sampler=4),
    r"must have one of LINEAR, STEP, .* as interpolation of channel 1 .*, got 'SMOOTH'": lambda h: sampler(
        h, 1, interpolation="SMOOTH"
    ),
    r"must have 9 values for the 3 keys of channel 1 .* CUBICSPLINE, got 3": lambda h: sampler(
        h, 1, interpolation="CUBICSPLINE"
    ),
    r"must have finite times from 0 on in ascending order in channel 0 .*, got 1 s at key 2": lambda h: sampler(
        h, 0, input=h["odd"]
    ),
    r"must refer to one of its 3 nodes in channel 2 of animation 0, got 7": lambda h: channel(
        h, 2, target={"node": 7, "path": "scale"}
    ),
    r"must have no matrix in node 1": lambda h: h["nodes"][1].update(matrix=np.eye(4).ravel().tolist()),
    r"must have floats or normalized integers as values of channel 3": lambda h: sampler(h, 3, output=h["bytes"]),
    r"must have 2 finite numbers for the weights of node 2": lambda h: sampler(h, 3, output=h["nine"]),
    r"must have 4 elements in POSITION of morph target 1 of primitive 0 of mesh 1": lambda h: targets(h)[1].update(
        POSITION=h["few"]
    ),
    r"must have 2 morph targets in primitive 1 of mesh 1": lambda h: h["meshes"][1]["primitives"].append(
        h["meshes"][1]["primitives"][0] | {"targets": targets(h)[:1]}
    ),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_damaged_animations_are_refused(tmp_path, message):
    writer = moving()
    writer.header["odd"] = writer.accessor(np.float32([0, 2, 1, 3]))
    writer.header["nine"] = writer.accessor(np.zeros(9, np.float32))
    writer.header["bytes"] = writer.accessor(np.zeros(18, np.uint8))
    writer.header["few"] = writer.accessor(np.ones((3, 3), np.float32))
    DAMAGE[message](writer.header)
    with pytest.raises(ValueError, match=rf"a\.glb.*({message})"):
        load_scene(writer.write(tmp_path / "a.glb"), time=0.5)


def test_wrong_times_and_animations_are_refused(tmp_path):
    path = moving().write(tmp_path / "a.glb")
    for options, message in (
        ({"time": -1}, "time must be at least 0"),
        ({"time": np.nan}, "time must be finite"),
        ({"time": 0, "animation": "walk"}, r"an animation of the name 'walk', got those of the names \['all'\]"),
        ({"time": 0, "animation": 1}, r"must have animation 1, got 1 animations"),
        ({"animation": 0}, "time must be a number of seconds where an animation is given"),
    ):
        with pytest.raises(ValueError, match=message):
            load_scene(path, **options)
    square = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "a.off").write_text(square)
    with pytest.raises(ValueError, match=r"a\.off must be a glTF file where a time is given"):
        load_scene(tmp_path / "a.off", time=0)
