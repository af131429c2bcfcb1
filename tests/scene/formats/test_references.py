"""Files that scenes refer to: only regular ones, and only in the scene's folder."""

import json
import os
import shutil
import sys
import urllib.parse
import warnings

import numpy as np
import pytest

from jaxprt.cli import info
from jaxprt.cli import inputs as command_inputs
from jaxprt.files import inputs, write_png
from jaxprt.scene import load_mesh, load_scene
from tests.scene.formats.gltf_writer import PLACE, SQUARE, Writer, one

OUTSIDE = "which is outside of it: move the file into the folder"
GRAY = np.full((2, 2, 3), 0.5, np.float32)
# Ways out of the folder "scene" to the file "secret" in the folder above. {above} is the absolute path of that.
WAYS = [
    "../secret",
    "inner/../../secret",
    "{above}/secret",
    "./..//secret",
    "link",
    "folder/secret",
    "linked",
    "..\\secret",
]
# The same for files that do not exist: the message must not tell.
ABSENT = ["../absent", "{above}/absent", "folder/absent", "/absent", "//host/share/absent", "inner\\..\\..\\absent"]


@pytest.fixture
def place(tmp_path):
    """The folder of a scene, with links out of it, beside a file that no scene may read."""
    folder = tmp_path / "scene"
    (folder / "inner").mkdir(parents=True)
    (tmp_path / "secret").write_bytes(SQUARE.tobytes() + PLACE.tobytes())
    write_png(tmp_path / "secret.png", GRAY)
    (tmp_path / "secret.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (folder / "link").symlink_to("../secret")
    (folder / "linked").symlink_to(folder / "link")
    (folder / "folder").symlink_to(tmp_path, target_is_directory=True)
    for suffix in (".png", ".mtl"):
        (folder / f"link{suffix}").symlink_to(f"../secret{suffix}")
        (folder / f"linked{suffix}").symlink_to(folder / f"link{suffix}")
    return folder


def scene_of_buffer(folder, uri):
    """A glTF file whose vertices are in a file."""
    writer = one((writer := Writer()).square(face=None, mode=6, NORMAL=None), writer=writer)
    header = writer.header | {"buffers": [{"byteLength": 48, "uri": uri}]}
    (folder / "a.gltf").write_text(json.dumps(header))
    return folder / "a.gltf"


def scene_of_image(folder, uri):
    """A glTF file whose texture is in a file."""
    writer = Writer()
    writer.header["images"] = [{"uri": uri}]
    writer.header["textures"] = [{"source": 0}]
    writer.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    return one(writer.square(material=0, TEXCOORD_0=PLACE), writer=writer).write(folder / "a.glb")


def scene_of_library(folder, name):
    """An OBJ file whose materials are in a file."""
    path = folder / "a.obj"
    path.write_text(f"mtllib {name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n")
    return path


def scene_of_map(folder, name):
    """An OBJ file whose texture is in a file."""
    (folder / "a.mtl").write_text(f"newmtl a\nKd 1 1 1\nmap_Kd {name}\n")
    return scene_of_library(folder, "a.mtl")


KINDS = {scene_of_buffer: "", scene_of_image: ".png", scene_of_library: ".mtl", scene_of_map: ".png"}


@pytest.mark.parametrize("kind", KINDS)
def test_files_outside_of_the_scenes_folder_are_refused_whether_they_exist_or_not(place, kind):
    for way in [*WAYS, *ABSENT]:
        name = way.format(above=place.parent) + KINDS[kind]
        forms = [name]
        if kind in (scene_of_buffer, scene_of_image):
            forms += [urllib.parse.quote(name), "".join(f"%{byte:02x}" for byte in name.encode())]
        for form in forms:
            path = kind(place, form)
            with pytest.raises(ValueError, match=OUTSIDE) as error:
                load_scene(path)
            assert str(path)[:-3] in str(error.value), form
            if kind is scene_of_buffer:
                with pytest.raises(ValueError, match=OUTSIDE):
                    load_mesh(path)


@pytest.mark.parametrize("kind", KINDS)
def test_they_are_read_where_the_user_allows_it(place, kind):
    for way in WAYS[:-1]:
        scene = load_scene(kind(place, way.format(above=place.parent) + KINDS[kind]), outside=True)
        material = scene.parts[0].material
        if kind is scene_of_buffer:
            assert len(scene.parts[0].mesh.face) == 2
        elif kind is scene_of_library:
            np.testing.assert_array_equal(material.base_color, [1, 0, 0])
        else:
            assert material.base_color_texture is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if kind is scene_of_buffer:
            with pytest.raises(FileNotFoundError, match="absent"):
                load_scene(kind(place, "../absent" + KINDS[kind]), outside=True)


@pytest.mark.parametrize("kind", KINDS)
def test_files_inside_are_read_by_any_way_that_ends_inside(place, kind):
    suffix = KINDS[kind]
    shutil.copy(place.parent / f"secret{suffix}", place / "inner" / f"my file{suffix}")
    (place / "inner" / f"near{suffix}").symlink_to(f"my file{suffix}")
    (place / "way").symlink_to("inner", target_is_directory=True)
    for way in ("inner/my file", "inner/../inner/my file", f"{place}/inner/my file", "inner/near", "way/near"):
        load_scene(kind(place, way + suffix))
    # The folder itself may be reached by a link.
    (place.parent / "other").symlink_to(place, target_is_directory=True)
    kind(place, "inner/near" + suffix)
    for path in place.glob("a.*"):
        if path.suffix != ".mtl":
            load_scene(place.parent / "other" / path.name)


def test_materials_in_an_inner_folder_may_name_images_anywhere_in_the_scenes_folder(place):
    shutil.copy(place.parent / "secret.png", place / "a.png")
    (place / "inner" / "a.mtl").write_text("newmtl a\nmap_Kd ..\\a.png\nmap_Pr ../inner/../a.png\n")
    path = scene_of_library(place, "inner/a.mtl")
    assert len(load_scene(path).parts[0].material.textures) == 2
    (place / "inner" / "a.mtl").write_text("newmtl a\nmap_Kd ../../secret.png\n")
    with pytest.raises(
        ValueError, match=r"inner/a\.mtl, map_Kd of material 'a' must refer to files in the folder of the"
    ):
        load_scene(path)
    (place / "inner" / "a.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1 -clamp on ../../secret.png\n")
    with pytest.raises(ValueError, match=OUTSIDE):
        load_scene(path)


def test_folders_are_separated_by_backslashes_as_on_windows_unless_a_file_has_that_name(place):
    (place / "inner" / "a.mtl").write_text("newmtl a\nKd 0 1 0\n")
    path = scene_of_library(place, "inner\\a.mtl")
    np.testing.assert_array_equal(load_scene(path).parts[0].material.base_color, [0, 1, 0])
    (place / "inner\\a.mtl").write_text("newmtl a\nKd 0 0 1\n")
    np.testing.assert_array_equal(load_scene(path).parts[0].material.base_color, [0, 0, 1])


@pytest.mark.parametrize(
    "uri",
    [
        "file:///etc/hostname",
        "file:/etc/hostname",
        "FILE:secret",
        "http://host/a.bin",
        "C:\\secret",
        "c:/secret",
        "C:secret",
    ],
)
def test_addresses_and_drives_are_refused_as_names_of_files(place, uri):
    for kind in (scene_of_buffer, scene_of_image):
        for outside in (False, True):
            with pytest.raises(ValueError, match=r"must name a file beside it in (buffer|image) 0, got"):
                load_scene(kind(place, uri), outside=outside)


@pytest.mark.parametrize("uri", ["%252e%252e/secret", "%252e%252e%252fsecret", "..%252fsecret"])
def test_names_are_decoded_once(place, uri):
    with pytest.raises(FileNotFoundError, match="%2"):
        load_scene(scene_of_buffer(place, uri))


def test_drives_in_libraries_are_names_like_others_elsewhere(place):
    with pytest.warns(UserWarning, match=r"ignored are map_Kd \(.*/scene/C:/pictures/a\.png, which does not exist\)"):
        load_scene(scene_of_map(place, "C:\\pictures\\a.png"))


@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize("name", ["a\0b", "a" * 300, "a/" * 3000, "circle", "circle/a"])
def test_names_that_no_file_can_have_are_refused(place, name, outside):
    (place / "circle").symlink_to("circle")
    with pytest.raises((ValueError, FileNotFoundError), match=r"a\.gl"):
        load_scene(scene_of_buffer(place, urllib.parse.quote(name)), outside=outside)
    if "\0" in name:
        with pytest.raises(ValueError, match=r"a\.mtl must be an MTL file, got one that is not text"):
            load_scene(scene_of_map(place, name))
        return
    if name.startswith("circle") and not outside and sys.version_info < (3, 13):  # which resolves links in a circle
        with pytest.raises(ValueError, match=r"a\.mtl, map_Kd of material 'a' must refer to a file"):
            load_scene(scene_of_map(place, name))
        return
    for kind in (scene_of_map, scene_of_image):
        with pytest.warns(UserWarning, match=r"ignored are .*, which (is not a regular file|does not exist)\)"):
            load_scene(kind(place, name), outside=outside)


def test_pipes_and_folders_in_place_of_files_are_refused_at_once(place):
    os.mkfifo(place / "pipe")
    for name, what in (("pipe", "special file"), ("inner", "directory"), (".", "directory")):
        with pytest.raises(ValueError, match=rf"must be the file that .*a\.gltf needs for buffer 0, got a {what}"):
            load_scene(scene_of_buffer(place, name))
    with pytest.raises(ValueError, match="got a special file"):
        load_scene(scene_of_buffer(place, "/dev/zero"), outside=True)
    for kind in (scene_of_library, scene_of_map, scene_of_image):
        with pytest.warns(UserWarning, match="pipe, which is not a regular file"):
            load_scene(kind(place, "pipe"))
    for suffix in (".gltf", ".glb"):
        os.mkfifo(place / f"pipe{suffix}")
        (place / f"folder{suffix}").mkdir()
        with pytest.raises(ValueError, match=f"pipe{suffix} must be a glTF file, got a special file"):
            load_scene(place / f"pipe{suffix}")
        with pytest.raises(ValueError, match=f"folder{suffix} must be a glTF file, got a directory"):
            load_scene(place / f"folder{suffix}")


def test_the_command_line_allows_it_by_an_option(place):
    path = scene_of_buffer(place, "../secret")
    with pytest.raises(ValueError, match="--outside"):
        command_inputs.scene([path])
    assert len(command_inputs.scene([path], outside=True).parts[0].mesh.face) == 2
    with pytest.raises(ValueError, match="--outside"):
        info.describe_path(path, 8, outside=False)
    assert info.describe_path(path, 8, outside=True)["triangles"] == 2


NAMES = {"Wood.PNG": "wood.png", "Bilder/gr\u00f6\u00dfe": "bilder/gro\u0308\u00dfe"}  # in the scene, and of the file


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_names_may_differ_from_those_of_files_in_case_and_unicode_form(place, kind, name):
    suffix, path = KINDS[kind], place / NAMES[name]
    path.parent.mkdir(exist_ok=True)
    shutil.copy(place.parent / f"secret{suffix}", f"{path}{suffix}")
    load_scene(kind(place, name + suffix))  # without a warning


@pytest.mark.parametrize("kind", KINDS)
def test_links_out_of_the_folder_are_refused_in_other_letters_too(place, kind):
    for name in (
        "LINK",
        "Linked",
        "FOLDER/secret",
        "FOLDER/SECRET",
        "Folder/absent",
        "../SECRET",
        "INNER/../../secret",
    ):
        with pytest.raises(ValueError, match=OUTSIDE):
            load_scene(kind(place, name + KINDS[kind]))
    # Folders outside are not searched, even where files in them are allowed.
    assert inputs.reference("../Secret.png", place, folder=place, owner="", outside=True) == place / "../Secret.png"
    assert not inputs.reference("FOLDER/SECRET.png", place, folder=place, owner="", outside=True).exists()


@pytest.mark.parametrize("kind", [scene_of_image, scene_of_map, scene_of_library])
def test_messages_shorten_names_that_are_data(place, kind):
    uri = "data:image/png;base64," + "A" * 10**6
    with pytest.warns(UserWarning, match="not supported and ignored are") as caught:
        load_scene(kind(place, uri))
    assert len(str(caught[0].message)) < 2000


def test_several_libraries_in_one_line_are_all_refused_outside(place):
    (place / "a.mtl").write_text("newmtl a\nKd 0 1 0\n")
    with pytest.raises(ValueError, match=r"a\.obj, mtllib must refer to files in the folder"):
        load_scene(scene_of_library(place, "a.mtl ../secret.mtl"))
    with pytest.raises(ValueError, match=OUTSIDE):
        load_scene(scene_of_library(place, "absent.mtl ../absent.mtl"))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("outside", ["no", 1, None])
def test_only_true_opens_files_outside(place, outside):
    with pytest.raises(TypeError, match="outside must be True or False, got"):
        load_scene(scene_of_map(place, "../secret.png"), outside=outside)
