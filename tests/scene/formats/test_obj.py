"""OBJ files as other programs write them.

OBJ files with MTL materials.
"""

import codecs
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.files import images, write_png
from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats import mesh_file
from jaxprt.scene.mesh import split

TRIANGLE = "v 0 0 0\nv 0 0 1\nv 1 0 0\nf 1 2 3\n"
POSITION = [[0, 0, 0], [0, 0, 1], [1, 0, 0]]
MARKS = {
    "utf-8-sig": codecs.BOM_UTF8,
    "utf-16-le": codecs.BOM_UTF16_LE,
    "utf-16-be": codecs.BOM_UTF16_BE,
    "utf-32-le": codecs.BOM_UTF32_LE,
}
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
IMAGE = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]], np.float32)  # Red, green; blue, white.


slope = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 4, 2))
NORMALS = np.float32(0.5 + 0.5 * np.concatenate([slope, np.sqrt(1 - (slope**2).sum(-1, keepdims=True))], -1))


def write(folder, text, name="scene.obj"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("encoding", MARKS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_byte_order_marks_and_line_ends_change_nothing(tmp_path, encoding, end):
    mark = b"" if encoding == "utf-8-sig" else MARKS[encoding]
    text = "mtllib böse.mtl\n" + TRIANGLE.replace("f ", "usemtl größe\nf ")
    text = text.replace("\n", end)
    material = f"newmtl größe{end}Kd 1 0 0{end}"
    write(tmp_path, mark + material.encode(encoding), "böse.mtl")
    (part,) = load_scene(write(tmp_path, mark + text.encode(encoding))).parts
    assert part.name == "größe"
    np.testing.assert_array_equal(part.mesh.position, POSITION)
    np.testing.assert_array_equal(part.material.base_color, [1, 0, 0])


@pytest.mark.parametrize("content", [TRIANGLE.encode("utf-16-le"), b"\xff\xfe" + b"\x00\xd8" * 3, b"v 0 0\0 0\n"])
def test_what_is_not_text_is_refused(tmp_path, content):
    with pytest.raises(ValueError, match=r"scene\.obj must be an undamaged OBJ file, got one that is not text"):
        load_mesh(write(tmp_path, content))
    write(tmp_path, "mtllib scene.mtl\n" + TRIANGLE)
    write(tmp_path, content, "scene.mtl")
    with pytest.raises(ValueError, match=r"scene\.mtl must be an MTL file, got one that is not text"):
        load_scene(tmp_path / "scene.obj")


@pytest.mark.parametrize("most", [1, 255])
def test_vertex_colors_are_the_base_color_decoded_from_srgb(tmp_path, most):
    rows = [f"{most} 0 0", f"0 {most} 0", f"{0.5 * most} {0.5 * most} {most}"]
    lines = [f"v {x} {y} {z} {rgb}" for (x, y, z), rgb in zip(POSITION, rows, strict=True)]
    (part,) = load_scene(write(tmp_path, "\n".join([*lines, "f 1 2 3"]))).parts
    gray = ((0.5 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(part.surface().base_color, [[1, 0, 0], [0, 1, 0], [gray, gray, 1]], atol=1e-6)
    assert float(part.material.specular) == 0


def test_vertex_colors_multiply_materials_and_are_left_out_where_there_is_an_image(tmp_path):
    write_png(tmp_path / "white.png", np.ones((2, 2, 3), np.float32))
    write(tmp_path, "newmtl half\nKd .5 .5 .5\nnewmtl image\nKd 1 1 1\nmap_Kd white.png\n", "scene.mtl")
    lines = [f"v {x} {y} {z} 1 0 0\nvt {x} {z}" for x, y, z in POSITION]
    faces = "usemtl half\nf 1/1 2/2 3/3\nusemtl image\nf 1/1 2/2 3/3\nusemtl none\nf 1/1 2/2 3/3\n"
    with pytest.warns(UserWarning, match=r"usemtl none \(no such material\)"):
        half, image, none = load_scene(write(tmp_path, "\n".join(["mtllib scene.mtl", *lines, faces]))).parts
    np.testing.assert_allclose(half.surface().base_color, [[0.5, 0, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(image.surface().base_color, [[1, 1, 1]] * 3, atol=1e-6)
    np.testing.assert_allclose(none.surface().base_color, [[1, 0, 0]] * 3, atol=1e-6)


@pytest.mark.parametrize("missing", ["v 1 0 0", "v 1 0 0 1", "v 1 0 0 nan 0 0", "v 1 0 0 inf 0 0"])
def test_vertices_without_color_stay_gray(tmp_path, missing):
    text = f"v 0 0 0 1 0 0\nv 0 0 1 0 0 1\n{missing}\nf 1 2 3\n"
    (part,) = load_scene(write(tmp_path, text)).parts
    np.testing.assert_allclose(part.surface().base_color, [[1, 0, 0], [0, 0, 1], [0.5, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_array_equal(part.mesh.position, POSITION)


def test_corners_of_different_form_may_be_mixed(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 2\n"
    text += "f 1/1 2/2 3/3\nf 1//1 3//1 4//1\nf 1/1/1 2/2/1 4//1\nf 1 2 3\nf 1/ 2// 3\n"
    geometry = mesh_file.read(write(tmp_path, text), groups=False)
    position, face = geometry.position, geometry.face
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(position[face], square[[[0, 1, 2], [0, 2, 3], [0, 1, 3], [0, 1, 2], [0, 1, 2]]])
    np.testing.assert_array_equal(geometry.texture[face[0]], [[0, 0], [1, 0], [1, 1]])
    np.testing.assert_array_equal(geometry.texture[face[1]], np.zeros((3, 2)))
    np.testing.assert_array_equal(np.isnan(geometry.normal[face]).all(2)[:, 0], [True, False, False, True, True])
    np.testing.assert_array_equal(geometry.normal[face[2]], [[0, 0, 2]] * 3)


def test_faces_with_missing_normals_are_loaded_without_them_and_a_warning_says_so(tmp_path):
    text = "v 0 0 0\nv 0 0 1\nv 1 0 0\nvn 1 0 0\nf 1//1 2//7 3//1\n"
    with pytest.warns(UserWarning, match=r"should refer to normals 1 to 1 or none, got 1 of 1 .* in line 5"):
        mesh = load_mesh(write(tmp_path, text))
    np.testing.assert_allclose(mesh.normal, [[0, 1, 0]] * 3, atol=1e-6)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("f 1 2", "three or more of the vertices 1 to ., got 1 of . faces that do not, the first is 'f 1 2' in line 6"),
        ("f 0/0/0 1/1/1 2/2/2", "the first is 'f 0/0/0 1/1/1 2/2/2' in line 6"),
        ("f 1 2 99999999999999999999999999", "in line 6"),
        ("f 1 2 -4", "in line 6"),
        ("f /1 /2 /3", "in line 6"),
        ("v 1 2", "v has 3 or more numbers, got 'v 1 2' in line 6"),
        ("v 1 x 2", "v has 3 or more numbers, got 'v 1 x 2' in line 6"),
        ("v 1_0 0 0", "v has 3 or more numbers, got 'v 1_0 0 0' in line 6"),
        (f"f 1 2 {'1' * 5000}", "the first is 'f 1 2 1111"),
        ("f 1/// 2/// 3///", "the first is 'f 1/// 2/// 3///' in line 6"),
        ("vn 1 0", "vn has 3 or more numbers, got 'vn 1 0' in line 6"),
        ("v 1e999 0 0\nf 1 2 4", "positions must be finite, .* the first is 'v 1e999 0 0' in line 6"),
    ],
)
def test_damaged_statements_are_refused_with_their_line(tmp_path, line, message):
    text = TRIANGLE.replace("f 1 2 3", "f 1 \\\n 2 3")
    with pytest.raises(ValueError, match=rf"scene\.obj.*{message}"):
        load_mesh(write(tmp_path, text + line))


def test_statements_in_different_blocks_belong_together_and_have_their_lines(tmp_path):
    with pytest.raises(ValueError, match=r"scene\.obj.*got 'v 1 x 2' in line 5"):
        load_mesh(write(tmp_path, TRIANGLE + "v 1 x 2" + "\n# nothing" * 70000 + "\nv 0 0 0\nf 1 2 3"))
    text = "v 0 0 0\n" + "\n" * 70000 + "v 1 0 0\nv 0 1 0 # far\nusemtl a\nf -3 -2 -1\n" + "#\n" * 70000
    text += "usemtl b\nf 1 2 3\nv 5 5 5 1 0 0\nusemtl a\nf -4 -3 -1"
    geometry = mesh_file.read(write(tmp_path, text), groups=False)
    corner = geometry.position[geometry.face]
    np.testing.assert_array_equal(corner[:, 2], [[0, 1, 0], [0, 1, 0], [5, 5, 5]])
    np.testing.assert_array_equal(geometry.region[geometry.face[:, 0]], [0, 1, 0])


def test_an_empty_material_name_is_that_of_faces_without_a_material(tmp_path):
    text = TRIANGLE + "usemtl \nf 3 2 1\nusemtl.map_off a\nusemtl\nf 1 2 3\n"
    with pytest.warns(UserWarning, match=r"ignored are statements usemtl\.map_off$"):
        (part,) = load_scene(write(tmp_path, text)).parts
    assert part.name == "scene"
    assert len(part.mesh.face) == 3


def write_materials(folder, materials, lines="usemtl a\n" + FACE, name="scene"):
    (folder / f"{name}.mtl").write_text(materials)
    path = folder / f"{name}.obj"
    path.write_text(f"mtllib {name}.mtl\n{SQUARE}{lines}")
    return path


def one(folder, statements):
    (part,) = load_scene(write_materials(folder, f"newmtl a\n{statements}")).parts
    return part


def test_parts_are_the_materials_in_order_of_their_first_faces(tmp_path):
    materials = "newmtl oak wood\nKd .1 .2 .3\nd 1\nTr 0.0\nKa 1 1 1\nnewmtl unused\nnewmtl steel\nPm 1\nPr .3\n"
    lines = FACE + "usemtl steel\n" + FACE + "usemtl oak wood\n" + FACE + "usemtl steel\n" + FACE
    path = write_materials(tmp_path, materials, lines)
    scene = load_scene(path)
    assert [part.name for part in scene.parts] == ["default", "steel", "oak wood"]
    assert [len(part.mesh.face) for part in scene.parts] == [2, 4, 2]
    for part, own in zip(scene.parts, split(load_mesh(path)), strict=True):
        np.testing.assert_array_equal(part.mesh.position, own.position)
    default, steel, wood = (part.material for part in scene.parts)
    assert (float(steel.metallic), float(steel.roughness)) == (1, pytest.approx(0.3))
    np.testing.assert_allclose(wood.base_color, [0.1, 0.2, 0.3], rtol=1e-6)
    assert (float(wood.metallic), float(wood.specular)) == (0, 0)
    np.testing.assert_array_equal(default.base_color, [0.5] * 3)


@pytest.mark.parametrize("exponent", [0, 500])
def test_phong_becomes_the_microfacets_nearest_to_its_lobe(tmp_path, exponent):
    material = one(tmp_path, f"Kd .5 .5 .5\nKs .2 .1 .04\nNs {exponent}\nNi 1.2\nillum 2\n").material
    # A Beckmann distribution of width m is near a power 2 / m^2 - 2 of the cosine: Walter et al. 2007, section 5.2.
    assert 2 / float(material.roughness) ** 4 - 2 == pytest.approx(exponent, abs=1e-2)
    reflectance = ((material.ior - 1) / (material.ior + 1)) ** 2 * material.specular_color * material.specular
    np.testing.assert_allclose(reflectance, [0.2, 0.1, 0.04], rtol=1e-5)
    matte = one(tmp_path, f"Kd .5 .5 .5\nKs .2 .1 .04\nNs {exponent}\nillum 1\n").material
    assert float(matte.specular) == 0


def test_metallic_roughness_statements_come_before_phongs(tmp_path):
    material = one(tmp_path, "Kd 1 1 1\nKs .5 .5 .5\nNs 250\nNi 1.45\nPr .25\nPm .5\nKe 2 1 0\nillum 2\n").material
    assert (float(material.roughness), float(material.metallic)) == (0.25, 0.5)
    assert float(material.ior) == pytest.approx(1.45)
    np.testing.assert_array_equal(material.specular_color, [1] * 3)
    np.testing.assert_array_equal(material.emissive, [2, 1, 0])


def exported(folder, header, statements):
    """The material of a file of Blender's, whose OBJ has a header."""
    path = write_materials(folder, f"# Blender 0 MTL File: 'None'\nnewmtl a\n{statements}")
    path.write_text(f"{header}\n{path.read_text()}")
    (part,) = load_scene(path).parts
    return part.material


@pytest.mark.parametrize(
    ("header", "exponent"),
    [("# Blender 3.6.0", 1000), ("# Blender 4.2.1 LTS", 1000), ("# Blender v2.93.5 OBJ File: ''", 900)],
)
@pytest.mark.parametrize(("roughness", "specular", "metallic"), [(0.5, 0.5, 0), (1, 1, 0.7), (0.3, 0, 0)])
def test_materials_that_blender_exports_come_back(tmp_path, header, exponent, roughness, specular, metallic):
    # As obj_export_mtl.cc writes them: the ambient color is the metalness, or 1 for dielectrics.
    illum, ambient = 1 if specular == 0 else 3 if metallic else 2, metallic or 1
    statements = f"Kd .8 .6 .4\nKe 0 0 0\nNi 1.45\nd 1\nillum {illum}\nNs {exponent * (1 - roughness) ** 2}\n"
    statements += "".join(f"{key} {gray} {gray} {gray}\n" for key, gray in (("Ka", ambient), ("Ks", specular)))
    material = exported(tmp_path, header, statements)
    assert float(material.roughness) == pytest.approx(roughness, abs=1e-6)
    assert float(material.metallic) == pytest.approx(metallic)
    reflectance = ((material.ior - 1) / (material.ior + 1)) ** 2 * material.specular_color * material.specular
    np.testing.assert_allclose(reflectance, [0.08 * specular] * 3, rtol=1e-5)
    assert float(material.specular) == (specular > 0)
    np.testing.assert_allclose(material.base_color, [0.8, 0.6, 0.4], rtol=1e-6)


def test_textures_that_blender_exports_replace_the_factors_and_its_bumps_are_normal_maps(tmp_path):
    write_png(tmp_path / "c.png", IMAGE)
    write_png(tmp_path / "n.png", NORMALS)
    maps = "map_Kd c.png\nmap_Pr c.png\nmap_Ke c.png\nmap_Bump -bm 0.5 n.png\n"
    statements = f"Kd .8 .8 .8\nKs .5 .5 .5\nKe 0 0 0\nNs 250\nPr .5\nPm .25\nillum 2\n{maps}"
    material = exported(tmp_path, "# Blender 4.2.1 LTS", statements)
    np.testing.assert_array_equal(material.base_color, [1] * 3)
    np.testing.assert_array_equal(material.emissive, [1] * 3)
    assert (float(material.roughness), float(material.metallic), float(material.normal_scale)) == (1, 0.25, 0.5)
    assert material.normal_texture is not None


@pytest.mark.parametrize("header", ["# Blender v2.79 (sub 0) OBJ File: ''", "# Blender3D v249 OBJ File: ", "# Maya"])
def test_materials_of_other_exporters_and_of_blender_before_principled_ones_are_phongs(tmp_path, header):
    material = exported(tmp_path, header, "Kd .5 .5 .5\nKs .5 .5 .5\nKa x\nNs 250\nillum 2\n")
    assert 2 / float(material.roughness) ** 4 - 2 == pytest.approx(250, rel=1e-4)
    np.testing.assert_allclose(material.specular_color, [12.5] * 3, rtol=1e-6)


def test_maps_lie_as_the_file_has_them_and_options_move_and_clamp_them(tmp_path):
    (tmp_path / "a folder").mkdir()
    write_png(tmp_path / "a folder" / "four colors.png", IMAGE)
    statements = "Kd .5 1 1\nmap_Kd a folder\\four colors.png\nmap_Pr a folder/four colors.png\n"
    part = one(tmp_path, statements + "map_Pm -s 1 1 1 -o .5 -clamp on a folder/four colors.png\n")
    place = np.asarray(part.mesh.texture)
    np.testing.assert_array_equal(place, [[0, 0], [1, 0], [1, 1], [0, 1]])
    lower_left = part.material.at(jnp.array([[0.25, 0.25]]))
    np.testing.assert_allclose(lower_left.base_color, [[0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(lower_left.roughness, [0], atol=1e-6)  # The channel of red.
    np.testing.assert_allclose(lower_left.metallic, [1], atol=1e-6)  # Moved by half the image: white.
    upper_right = part.material.at(jnp.array([[0.75, 0.75]]))
    np.testing.assert_allclose(upper_right.base_color, [[0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(upper_right.metallic, [0], atol=1e-6)  # Beyond the edge: green.


def test_libraries_and_images_are_read_once_and_only_those_of_used_materials(tmp_path, monkeypatch):
    write_png(tmp_path / "a.png", IMAGE)
    decoded, decode = [], images.decode_image
    monkeypatch.setattr(
        images, "decode_image", lambda *args, **how: decoded.append(how["name"]) or decode(*args, **how)
    )
    materials = "".join(f"newmtl m{number}\nmap_Kd a.png\nmap_Ke -s 2 a.png\nmap_Pr a.png\n" for number in range(9))
    materials += "newmtl unused\nKd x\nhair\nmap_Kd absent.png\nmap_Ke ../outside.png\n"
    path = write_materials(tmp_path, materials, f"usemtl m1\n{FACE}usemtl m7\n{FACE}")
    path.write_text("mtllib scene.mtl\nmtllib ./scene.mtl\n" + path.read_text())
    first, second = (part.material for part in load_scene(path).parts)  # without a warning
    assert decoded == [str(tmp_path / "a.png")] * 2  # as colors, and as roughness
    assert first.base_color_texture.image is second.base_color_texture.image is second.emissive_texture.image
    assert first.roughness_texture.image is second.roughness_texture.image
    np.testing.assert_array_equal(first.emissive_texture.transform, [[2, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(first.base_color_texture.image, IMAGE, atol=1e-6)


@pytest.mark.parametrize(
    ("statement", "alpha"),
    [("d 0.5", 0.5), ("d -halo 1.0", None), ("d 1 # -halo", None), ("Tr .25", 0.75), ("d .5\nTr .5", 0.5)],
)
def test_d_and_tr_are_opacities(tmp_path, statement, alpha):
    material = one(tmp_path, f"{statement}\n").material
    got = None if material.alpha_mode == "opaque" else float(material.alpha)
    assert (got, material.alpha_mode) == (alpha, "opaque" if alpha is None else "blend")


@pytest.mark.parametrize("name", ["two  spaces", "wide\u3000space", "hard\xa0space"])
def test_names_of_materials_and_images_are_read_as_they_stand(tmp_path, name):
    write_png(tmp_path / f"{name}.png", np.full((1, 1, 3), 0.5))
    write_png(tmp_path / f"{' '.join(name.split())}.png", np.ones((1, 1, 3)))
    write_png(tmp_path / f"{name}.png", np.full((1, 1, 3), 0.5))
    path = write_materials(tmp_path, f"newmtl {name}\nmap_Kd -s 1 1 1 {name}.png\n", f"usemtl {name}\n{FACE}")
    (part,) = load_scene(path).parts
    assert part.name == name
    assert float(np.max(part.material.base_color_texture.image)) < 0.9


def test_map_d_is_the_alpha_of_an_image_or_else_its_gray(tmp_path):
    write_png(tmp_path / "alpha.png", np.array([[[0.1, 0.1, 0.1, 0.2]]]))
    write_png(tmp_path / "gray.png", np.array([[[0.2, 0.1, 0.1]]]))
    for name in ("alpha", "gray"):
        material = one(tmp_path, f"d .5\nmap_d {name}.png\n").material
        assert (float(material.alpha), material.alpha_mode) == (0.5, "blend")
        np.testing.assert_allclose(material.alpha_texture.image, [[[0.2]]], rtol=1e-6)
    with pytest.warns(UserWarning, match="ignored are Tr beside d$"):
        assert float(one(tmp_path, "d .5\nTr .2\n").material.alpha) == 0.5
    with pytest.warns(UserWarning, match="ignored are d below 0 or above 1"):
        assert float(one(tmp_path, "d -1\n").material.alpha) == 0


REFRACTED = r"illum {} \(glass: nothing is refracted, and only d, Tr and map_d let light through\)"


@pytest.mark.parametrize(
    ("statements", "words"),
    [
        *((f"Kd 0 0 0\nTf 1 1 1\nNi 1.5\nillum {model}", REFRACTED.format(model)) for model in (4, 9)),
        ("d .5\nTf 1 0 0", r"Tf 1 0 0 \(the color of light that passes through\)"),
        ("d 0", r"faces of material 'a' \(they are invisible: its opacity is 0\)"),
        ("map_d black.png", r"faces of material 'a' \(they are invisible: its opacity is 0\)"),
        ("Kd 1 0 0\nKd 0 1 0", "all but the last Kd of material 'a'"),
        ("Kd 1 0 0\nnewmtl a\nKd 0 1 0", "all but the last newmtl a"),
        ("aniso .5\nanisor .2", "aniso"),
        ("Pr .3\nKs .9 .1 .1\nmap_Kd", "Ks beside Pr and Pm, map_Kd without a file"),
        ("Ps .4\nPc 1", r"Ps beside Pc \(sheens under clear coats\)"),
        ("Pr .5\nNi .5", "Ni below 1"),
        ("map_Ks black.png\ndisp black.png\nrefl -type sphere black.png", "disp, map_Ks, refl"),
        ("norm normal.png\nbump black.png", "bump beside norm"),
        ("map_Pr -mm .1 .9 -blendu off -clamp yes -imfchan z black.png", "option -blendu of maps, .*-mm of maps"),
    ],
)
def test_what_changes_the_picture_and_is_not_read_is_named(tmp_path, statements, words):
    write_png(tmp_path / "black.png", np.zeros((2, 2, 3), np.float32))
    write_png(tmp_path / "normal.png", NORMALS)
    with pytest.warns(UserWarning, match=rf"not supported and ignored are {words}$"):
        one(tmp_path, statements)


def test_statements_without_effect_are_not_named(tmp_path):
    write_png(tmp_path / "n.png", NORMALS)
    neutral = "-blendu on -blendv on -cc off -mm 0 1 -t 0 0 0 -clamp off -texres 512"
    statements = "Tf 1 1 1\nillum 5\naniso 0\nanisor .2\nPc 0\nPs 0\nKd 1 0 0\nKd 1 0 0\n"
    statements += f"map_Pm {neutral} -imfchan g n.png\n"
    material = one(tmp_path, f"{statements}newmtl a\n{statements}").material
    np.testing.assert_allclose(material.metallic_texture.image, NORMALS[..., 1:2], atol=1 / 255)
    assert (float(material.clearcoat), float(np.max(material.sheen_color))) == (0, 0)


def test_coats_and_sheens_are_read(tmp_path):
    material = one(tmp_path, "Pr .5\nPc .75\nPcr .25\n").material
    assert (float(material.clearcoat), float(material.clearcoat_roughness)) == (0.75, 0.25)
    material = one(tmp_path, "Ps .25\n").material
    np.testing.assert_array_equal(material.sheen_color, [0.25] * 3)
    assert float(material.sheen_roughness) == 0.5


@pytest.mark.parametrize("key", ["map_Bump", "map_bump", "bump", "norm"])
def test_bumps_are_normal_maps_where_their_images_hold_normals(tmp_path, key):
    write_png(tmp_path / "n.png", NORMALS)
    material = one(tmp_path, f"{key} -bm 0.7 n.png\n").material
    np.testing.assert_allclose(material.normal_texture.image, NORMALS, atol=1 / 255)
    assert float(material.normal_scale) == pytest.approx(0.7)
    # Heights, of which 0.789 has the unit length of a normal; a blue color; and normals that point inward.
    random = np.random.default_rng(0).random((4, 4, 1))
    wrong = [np.repeat(random, 3, 2), np.full((4, 4, 3), 0.789), np.full((4, 4, 3), [0.4, 0.5, 0.8]), 1 - NORMALS]
    for image in wrong if key != "norm" else []:
        write_png(tmp_path / "h.png", np.float32(image))
        with pytest.warns(UserWarning, match=rf"{key} \(.*h\.png holds no normals: heights are not read\)$"):
            assert one(tmp_path, f"{key} h.png\n").material.normal_texture is None


@pytest.mark.parametrize(("key", "name"), [("Kd", "base_color"), ("Ke", "emissive"), ("Pr", "roughness"), ("Ps", "")])
def test_factors_of_zero_beside_their_maps_count_as_one(tmp_path, key, name):
    write_png(tmp_path / "c.png", IMAGE)
    with pytest.warns(UserWarning, match=rf"ignored are {key} of 0 beside map_{key} \(it counts as 1\)$"):
        material = one(tmp_path, f"{key} 0\nmap_{key} c.png\n").material
    np.testing.assert_array_equal(getattr(material, name or "sheen_color"), 1)
    np.testing.assert_array_equal(getattr(one(tmp_path, f"map_{key} c.png\n").material, name or "sheen_color"), 1)


def test_materials_of_several_files_are_those_of_the_first(tmp_path):
    path = write_materials(tmp_path, "newmtl a\nKd 1 0 0\n")
    path.write_text("mtllib scene.mtl other.mtl\n" + path.read_text().partition("\n")[2])
    write(tmp_path, "newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 1\n", "other.mtl")
    load_scene(path)  # without a warning: they are the same
    write(tmp_path, "newmtl a\nKd 0 1 0\n", "other.mtl")
    with pytest.warns(UserWarning, match=r"newmtl a of .*other\.mtl \(a file before it has another\)$"):
        np.testing.assert_array_equal(load_scene(path).parts[0].material.base_color, [1, 0, 0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "v 0 0 0 1\nv 0 0 1 .5\nv 1 0 0 1\nf 1 2 3",
            r"the fourth number of vertices, a weight \(polygons have none\)",
        ),
        ("v 0 0 0 1 0 0 .5\nv 0 0 1 1 0 0\nv 1 0 0\nf 1 2 3", "numbers of vertices beyond x y z w and x y z r g b"),
        (TRIANGLE + "l 1 2\np 1\nusemap x\ns off\nlod 1\n", "statements l, statements p, statements usemap"),
        ("s off\n" + TRIANGLE + "s 1\n", r"smoothing groups \(s\) of faces without normals"),
        ("v 0 0 0 3.5 .5 .5\nv 0 0 1 .5 .5 .5\nv 1 0 0 .2 .5 .5\nf 1 2 3", "colors below 0 or above 1"),
        (TRIANGLE + "".join(f"x{number}\n" for number in range(11)), "3 statements more, statements x0, .*"),
    ],
)
def test_what_is_not_read_of_the_geometry_is_named(tmp_path, text, words):
    with pytest.warns(UserWarning, match=f"not supported and ignored are {words}$"):
        (part,) = load_scene(write(tmp_path, text)).parts
    np.testing.assert_array_equal(part.mesh.position, POSITION)


@pytest.mark.parametrize(
    "text", ["v 0 0 0\nv 1 0 0\nv 2 0 0\n", "v 3 3 3\n" * 3, "v .1 .2 .3\nv .2 .4 .6\nv .3 .6 .9\n"]
)
def test_files_of_faces_without_area_are_refused(tmp_path, text):
    with pytest.raises(ValueError, match=r"scene\.obj must hold faces with an area, got 2 faces without"):
        load_mesh(write(tmp_path, text + "f 1 2 3\nf 1 1 2\n"))
    assert len(load_mesh(write(tmp_path, text + "v 1 0 9\nv 5 5 5\nf 1 1 2\nf 1 4 5\n")).face) == 2


def test_comments_end_names_only_where_their_sign_stands_alone(tmp_path):
    write_png(tmp_path / "c#1.png", IMAGE)
    materials = "newmtl M_#1 # first\nKd 1 0 0 # red\nmap_Kd c#1.png # four colors\nnewmtl M_#2 #\nKd 0 1 0#green\n"
    path = write_materials(tmp_path, materials, f"usemtl M_#1 # first\n{FACE}usemtl M_#2\n{FACE}usemtl M_#1\n{FACE}")
    path.write_text(path.read_text().replace("scene.mtl", "scene.mtl # materials"))
    first, second = load_scene(path).parts  # Without a warning of anything missing.
    assert (first.name, second.name) == ("M_#1", "M_#2")
    assert (len(first.mesh.face), len(second.mesh.face)) == (4, 2)
    np.testing.assert_array_equal(first.material.base_color, [1, 0, 0])
    np.testing.assert_array_equal(second.material.base_color, [0, 1, 0])
    assert first.material.base_color_texture is not None


def test_what_is_missing_or_not_honored_is_said_once_by_name(tmp_path):
    statements = "Kd 2 1 1\nbump a.png\nmap_Kd absent.png\nmap_Ke text.png\naniso 1\n"
    (tmp_path / "text.png").write_text("no picture")
    path = write_materials(tmp_path, f"newmtl a\n{statements}", "usemtl a\n" + FACE + "usemtl b\n" + FACE)
    path.write_text("mtllib gone.mtl\n" + path.read_text())
    with pytest.warns(UserWarning, match="not supported and ignored") as caught:
        scene = load_scene(path)
    (message,) = [str(each.message) for each in caught]
    assert message.startswith(f"{path}: not supported and ignored are ")
    expected = ["Kd above 1", "aniso", "bump", r"absent.png, which does not exist", "text.png must be an EXR"]
    for each in [*expected, "gone.mtl, which does not exist", "usemtl b (no such material)"]:
        assert message.count(each) == 1, each
    np.testing.assert_array_equal(scene["a"].material.base_color, [1, 1, 1])
    assert scene["a"].material.textures == ()
    np.testing.assert_array_equal(scene["b"].material.base_color, [0.5] * 3)
    path.write_text(SQUARE + FACE)
    assert [part.name for part in load_scene(path).parts] == [path.stem]


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("Kd 1 x 1", "material 'a': Kd must have finite numbers, got 'Kd 1 x 1'"),
        ("Ns nan", "material 'a': Ns must have finite numbers, got 'Ns nan'"),
        ("Kd", "material 'a': Kd must have finite numbers, got 'Kd'"),
        (
            "Kd spectral a.rfl",
            r"material 'a': Kd must have finite numbers, got 'Kd spectral a.rfl' \(1 or 3 of linear RGB; spec",
        ),
        ("Pr -1", "material 'a': roughness of TexturedMaterial must be between 0 and 1"),
        ("map_Kd -s 1e300 1 1 a.png", "map_Kd of material 'a': the texture's transform must be finite"),
        ("norm -bm 1e300 a.png", "material 'a': normal_scale"),
    ],
)
def test_damaged_numbers_are_refused_by_name(tmp_path, statement, message):
    write_png(tmp_path / "a.png", IMAGE)
    with pytest.raises(ValueError, match=f"scene.mtl, {message}"):
        one(tmp_path, statement)


@pytest.mark.parametrize("name", ["fuze", "chair_model"])
def test_real_files_have_the_regions_of_their_meshes_and_say_what_is_missing(data, name):
    path = data / f"meshes_awkward/{name}.obj"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load_scene(path)
    assert len(caught) <= 1
    own = split(load_mesh(path))
    assert [len(part.mesh.face) for part in scene.parts] == [len(each.face) for each in own]
    for part in scene.parts:
        assert np.isfinite(part.surface().base_color).all()
