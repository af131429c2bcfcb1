"""Scenes made in memory, and files without materials; see test_gltf.py for those with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxprt import brdf
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial, builtin, load_scene
from jaxprt.scene.mesh import Mesh, make_mesh, split

BALL, PLANE = builtin.sphere(rings=4, sectors=5), builtin.plane(cells=2)
CAMERA = Camera([0.0, 0, 3], [0.0, 0, 0], [0.0, 1, 0], 0.5, 8, 6)


def textured():
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    return make_mesh(position, np.array([[0, 1, 2]]), texture=position[:, :2])


def scene():
    paper = TexturedMaterial(base_color_texture=Texture(jnp.ones((2, 2, 3))))
    parts = [Part("ball", BALL, brdf.Lambert(0.5)), Part("sheet", textured(), paper), Part("plane", PLANE, brdf.Ward())]
    return Scene(parts, [CAMERA], [Environment(jnp.ones((6, 2, 2, 3)))])


def test_the_mesh_of_a_scene_has_one_region_for_each_part():
    many = Mesh(
        *(getattr(BALL, name) for name in ("position", "face", "normal", "tangent")), jnp.arange(len(BALL.region))
    )
    parts = [Part("many regions", many, brdf.Lambert()), *scene().parts[1:]]
    whole = Scene(parts).mesh
    counts = [len(part.mesh.position) for part in parts]
    np.testing.assert_array_equal(whole.region, np.repeat([0, 1, 2], counts))
    for part, own in zip(parts, split(whole), strict=True):
        np.testing.assert_array_equal(part.mesh.position, own.position)
        np.testing.assert_array_equal(part.mesh.face, own.face)


def test_parts_are_found_by_name():
    assert scene()["plane"].mesh.position.shape == PLANE.position.shape
    with pytest.raises(KeyError, match=r"there is no part 'bowl', only \['ball', 'sheet', 'plane'\]"):
        scene()["bowl"]


def test_the_parameters_of_a_part_are_those_at_its_vertices(close):
    image = jnp.asarray(np.random.default_rng(0).uniform(size=(3, 3, 3)), jnp.float32)
    material = TexturedMaterial(base_color=[0.5, 1, 1], base_color_texture=Texture(image, set=1))
    second, color = (
        jnp.array([[0.5, 0.5], [1 / 6, 5 / 6], [5 / 6, 0.5]]),
        jnp.array([[1.0, 1, 1], [0, 1, 1], [1, 1, 0.5]]),
    )
    part = Part("a", textured(), material, color=color, second=second)
    close(part.surface().base_color, np.stack([image[1, 1], image[0, 0], image[1, 2]]) * color * jnp.array([0.5, 1, 1]))
    plain = Part("b", BALL, TexturedMaterial(metallic=0.25)).surface()
    np.testing.assert_array_equal(plain.metallic, np.full(len(BALL.position), 0.25))
    with pytest.raises(
        TypeError, match=r"material of part 'ball' must be of class TexturedMaterial, .* got one of class"
    ):
        scene()["ball"].surface()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("build", "kind", "message"),
    [
        (lambda: Scene([]), ValueError, "a scene must have at least one part, got none"),
        (
            lambda: Scene([Part(name, BALL, brdf.Lambert()) for name in ("a", "b", "a")]),
            ValueError,
            r"the parts of a scene must have different names, got several named \['a'\]",
        ),
        (
            lambda: Scene(scene()["ball"]),
            TypeError,
            "a scene takes lists of parts, cameras, environments, point_lights and suns, got one Part",
        ),
        (lambda: Scene([BALL]), TypeError, "each of the scene's parts must be of class Part"),
        (lambda: Scene(scene().parts, [BALL]), TypeError, "each of the scene's cameras must be of class Camera"),
        (lambda: Part(3, BALL, brdf.Lambert()), TypeError, "the name of a part must be text, got 3"),
        (
            lambda: Part("a", BALL, "wood"),
            TypeError,
            "material of part 'a' must be a TexturedMaterial or a BRDF, got str",
        ),
        (
            lambda: Part("a", jax.tree.map(lambda x: x[:0], BALL), brdf.Lambert()),
            ValueError,
            "part 'a' must have vertices and faces, got 0 vertices and 0 faces",
        ),
        (
            lambda: Part("a", textured(), TexturedMaterial(normal_texture=Texture(jnp.ones((1, 1, 3)), set=1))),
            ValueError,
            "part 'a' must have second for the textures of its material, got None",
        ),
        (
            lambda: Part("a", BALL, brdf.Lambert(), color=jnp.ones((2, 3))),
            ValueError,
            "rows of color of part 'a' must be .*, got 2",
        ),
    ],
)
def test_impossible_scenes_are_refused_by_name(build, kind, message):
    with pytest.raises(kind, match=message):
        build()


@pytest.mark.parametrize("mirrored", [False, True])
def test_frames_of_normal_maps_lie_along_the_texture_unless_their_handedness_is_given(mirrored, close):
    mesh = textured()
    place = np.asarray(mesh.texture)[:, ::-1] * [-1 if mirrored else 1, -1]  # u along y, or along -y
    mesh = make_mesh(mesh.position, mesh.face, texture=place)
    bumps = {"normal_texture": Texture(jnp.full((1, 1, 3), 0.5))}
    part = Part("sheet", mesh, TexturedMaterial(**bumps))
    along, hand = ([0.0, -1, 0], -1) if mirrored else ([0.0, 1, 0], 1)
    close(part.mesh.tangent, [along] * 3, tolerance=1e-6)
    np.testing.assert_array_equal(part.handedness, [hand] * 3)
    given = Part("sheet", mesh, TexturedMaterial(**bumps), handedness=np.ones(3))
    smooth = Part("sheet", mesh, TexturedMaterial(roughness=0.3))
    for kept in (given, smooth):
        np.testing.assert_array_equal(kept.mesh.tangent, mesh.tangent)
    brushed = Part("sheet", mesh, TexturedMaterial(anisotropy=0.5))
    np.testing.assert_array_equal(brushed.mesh.tangent, part.mesh.tangent)


@pytest.mark.parametrize("suffix", ["ply", "stl", "off"])
def test_files_without_materials_are_one_matte_gray_part(tmp_path, suffix):
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / f"ball.{suffix}")
    (part,) = load_scene(tmp_path / f"ball.{suffix}").parts
    assert part.name == "ball"
    assert (float(part.material.metallic), part.material.base_color.tolist()) == (0, [0.5] * 3)
    with pytest.raises(FileNotFoundError, match="must be a mesh file, and there is no such file"):
        load_scene(tmp_path / f"absent.{suffix}")
    with pytest.raises(ValueError, match=r"must end in one of .*, got '\.blend'"):
        load_scene(tmp_path / "hat.blend")
