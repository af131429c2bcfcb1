"""Baked glTF: colors are the radiance of its light and view, and the file says so."""

import json
import struct

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxprt import view


def test_colors_are_radiance_and_faces_are_seen_from_outside(systems, lights, tmp_path):
    scene, path = systems["lobes"], tmp_path / "piece.glb"
    eye = jnp.asarray([3.0, 1.0, 2.0])
    exposure = view.export_baked(scene, path, lights["lamp"], eye=eye)
    true = np.maximum(np.asarray(scene.radiance(lights["lamp"], eye=eye)), 0)
    found = trimesh.load(path, process=False)
    names = [f"{name}, baked for one light and one view" for name in ("ball", "ground")]
    assert sorted(found.geometry) == names
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    head = json.loads(data[20 : 20 + length])
    assert head["asset"]["extras"] == {"baked": True, "eye": [3.0, 1.0, 2.0], "exposure": exposure}
    assert head["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    first = 0
    for mesh, part in zip(head["meshes"], scene.scene.parts, strict=True):
        accessor = head["accessors"][mesh["primitives"][0]["attributes"]["COLOR_0"]]
        place = 28 + length + head["bufferViews"][accessor["bufferView"]]["byteOffset"]
        color = np.frombuffer(data, "<f4", 3 * accessor["count"], place).reshape(-1, 3)
        count = len(part.mesh.position)
        np.testing.assert_allclose(exposure * color, true[first : first + count], rtol=1e-5, atol=1e-6)
        assert color.max() <= 1
        first += count
    ball = found.geometry[names[0]]
    assert np.all(np.sum(ball.face_normals * ball.triangles_center, 1)[ball.area_faces > 1e-6] > 0)


def test_another_kind_of_file_is_refused(systems, lights, tmp_path):
    with pytest.raises(ValueError, match=r"path must end in \.glb, .* got '.*a\.gltf'"):
        view.export_baked(systems["lobes"], tmp_path / "a.gltf", lights["lamp"])
