"""Files in place of which something else stands, for every function that reads one."""

import os

import pytest

from jaxprt.brdf import load_lafortune, load_merl, load_ngan, load_npf, load_scattered, navigation
from jaxprt.files import read_image
from jaxprt.scene import load_environment, load_mesh, load_scene
from jaxprt.scene.formats import nerf

READERS = {
    "lafortune.json": lambda path: load_lafortune(path, "clay"),
    "ngan.fit": lambda path: load_ngan(path, "nickel"),
    "scattered.brdf": load_scattered,
    "table.csv": lambda path: navigation.cook_torrance(path=path),
    "merl.binary": load_merl,
    "npf.bin": lambda path: load_npf(path, "iron", names=path),
    "image.png": read_image,
    "sky.hdr": load_environment,
    "transforms.json": nerf.load,
    **{f"mesh.{suffix}": load_mesh for suffix in ("ply", "obj", "off", "stl", "glb", "gltf")},
    **{f"scene.{suffix}": load_scene for suffix in ("ply", "obj", "off", "stl", "glb", "gltf")},
}


@pytest.mark.parametrize("name", READERS)
def test_pipes_folders_and_names_that_no_file_has_are_refused(tmp_path, name):
    read, suffix = READERS[name], name.partition(".")[2]
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    (tmp_path / f"folder.{suffix}").mkdir()
    for stem, kind in (("pipe", "special file"), ("folder", "directory")):
        with pytest.raises(ValueError, match=rf"{stem}\.{suffix} must be .*got a {kind}"):
            read(tmp_path / f"{stem}.{suffix}")
    with pytest.raises(FileNotFoundError, match=rf"none\.{suffix}.* there is no such file"):
        read(tmp_path / f"none.{suffix}")
    with pytest.raises(ValueError, match=r"must be the path of .*, got one with File name too long"):
        read(tmp_path / f"{'a' * 300}.{suffix}")


def test_meshes_of_unknown_formats_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"hat\.blend must end in one of \.ply, \.obj, .*, got '\.blend'"):
        load_scene(tmp_path / "hat.blend")
