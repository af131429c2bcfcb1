"""Materials of many parts as columns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from jaxprt.scene import Texture, TexturedMaterial, builtin, material_table, texture
from jaxprt.scene.mesh import make_mesh
from jaxprt.scene.points import Points


def part(name: str, material: TexturedMaterial, seed: int) -> prt.Part:
    """A small sphere with texture coordinates."""
    ball = builtin.sphere(rings=4, sectors=6)
    place = np.random.default_rng(seed).uniform(-1, 2, (len(ball.position), 2)).astype(np.float32)
    return prt.Part(name, make_mesh(ball.position, ball.face, normal=ball.normal, texture=place), material)


def image(*shape: int, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform(0.2, 0.8, shape), jnp.float32)


def parts() -> list[prt.Part]:
    """Two parts with textures of different sizes, and one without."""
    mirrored = Texture(image(4, 5, 3), [[0.5, 0.2, 0.1], [-0.3, 0.7, 0]], 0, ("clamp", "mirror"))
    rough = Texture(image(16, 8, 1, seed=1))
    first = TexturedMaterial(0.9, 0.6, 0.7, base_color_texture=mirrored, roughness_texture=rough)
    second = TexturedMaterial(
        [0.2, 0.5, 0.9], 0.3, 0.8, metallic_texture=rough, emissive=0.4, emissive_texture=mirrored
    )
    return [part("a", first, 0), part("b", second, 1), part("c", TexturedMaterial(0.5, 0.0, 0.3), 2)]


def test_columns_hold_the_materials_of_each_part(close):
    look, first = material_table.of_parts(parts()).at_vertices(), 0
    for each in parts():
        own, alone = slice(first, first + len(each.mesh.position)), each.surface()
        for name in ("base_color", "metallic", "roughness", "emissive", "specular", "specular_color", "ior"):
            close(getattr(look.values, name)[own], getattr(alone, name), tolerance=1e-5)
        first = own.stop
    assert first <= len(look.log_roughness)  # padding follows


def test_materials_with_fewer_textures_keep_all_shapes(close):
    table = material_table.of_parts(parts())
    plain = [TexturedMaterial(0.1 * number, 0.0, 0.5) for number in range(3)]
    other = material_table.with_materials(table, plain, [each.material for each in parts()])
    assert jax.tree.map(np.shape, other) == jax.tree.map(np.shape, table)
    size = [len(each.mesh.position) for each in parts()]
    close(other.at_vertices().values.base_color[: sum(size), 0], np.repeat([0.0, 0.1, 0.2], size))
    again = material_table.with_materials(other, [each.material for each in parts()], plain)
    for one, two in zip(again.at_vertices().values, table.at_vertices().values, strict=True):
        close(one, two)


def test_texels_are_kept_where_there_are_no_new_images():
    before = [each.material for each in parts()]
    table = material_table.of_parts([part("a", before[0], 0), part("b", before[1], 1), part("c", before[2], 2)])
    tinted = [dataclasses.replace(before[0], base_color=[0.1, 0.2, 0.3]), before[2], before[1]]
    other = material_table.with_materials(table, tinted, before)
    assert other.texels is table.texels
    np.testing.assert_array_equal(other.image[1], -1)
    np.testing.assert_array_equal(other.image[2], table.image[1])


def test_textures_are_averaged_over_the_pixel_of_a_point(close):
    """Four texels read the level of half that size, all texels their mean, and a thin pixel four probes.

    A pixel counts as smaller than it is when a level is chosen, because levels are blurred themselves.
    """
    texels = image(16, 16, 3, seed=4)
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    square = make_mesh(corner, np.array([[0, 2, 1]]), texture=corner[:, [0, 2]])
    material = TexturedMaterial(1.0, 0.0, 1.0, base_color_texture=Texture(texels))
    table = material_table.of_parts([prt.Part("square", square, material)])
    place = np.array([[0.31, 0.27], [0.52, 0.13], [0.11, 0.64]], np.float32)

    def read(across, down):
        weight = np.stack([1 - place.sum(1), *place.T])
        wide = np.array([[-sum(way), *way] for way in (across, down)]) / material_table.SHARPER
        slope = np.broadcast_to(wide[..., None], (2, 3, 3))
        points = Points(np.repeat([[0], [1], [2]], 3, 1).astype(np.int32), weight, slope.astype(np.float32))
        return table.at(points).values.base_color

    half = np.asarray(texels).reshape(8, 2, 8, 2, 3).mean((1, 3))
    close(read([0, 0], [0, 0]), texture.lookup(texels, place), tolerance=1e-5)
    close(read([2 / 16, 0], [0, 2 / 16]), texture.lookup(jnp.asarray(half), place), tolerance=1e-5)
    close(read([1, 0], [0, 1]), np.broadcast_to(np.mean(texels, (0, 1)), (3, 3)), tolerance=1e-5)
    apart = np.float32([1 / 16 / material_table.SHARPER, 0])
    probes = [texture.lookup(texels, place + (n - 1.5) * apart) for n in range(4)]
    close(read([4 / 16, 0], [0, 0]), np.mean(probes, 0), tolerance=1e-5)


def bumpy(mesh, texel, **more) -> material_table.MaterialTable:
    """The table of one part with a normal map."""
    material = TexturedMaterial(1.0, 0.0, 0.3, normal_texture=Texture(texel), **more)
    return material_table.of_parts([prt.Part("bumpy", mesh, material)])


def test_normals_of_a_map_are_averaged_over_a_pixel_and_their_spread_is_roughness(close):
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1]])
    tangent = np.broadcast_to([1.0, 0, 0], (3, 3))
    square = make_mesh(corner, np.array([[0, 1, 2]]), tangent=tangent, texture=np.abs(corner[:, [0, 2]]))
    side = np.where(np.arange(16) % 2, 0.6, -0.6)  # every second column of texels leans to the other side
    normal = np.stack([side, 0 * side, np.full(16, 0.8)], -1)
    table = bumpy(square, np.float32(np.broadcast_to((normal + 1) / 2, (16, 16, 3))))

    def look(width):
        weight = np.float32([[0.75 - 5.5 / 16], [5.5 / 16], [0.25]])
        slope = np.float32([[[-width], [width], [0]], [[-width], [0], [width]]])
        return table.at(Points(np.int32([[0], [1], [2]]), weight, slope))

    near, far = look(1e-3 / 16), look(2 / 16 / material_table.SHARPER)
    close(near.normal, [[0.6, 0.8, 0.0]], tolerance=1e-4)
    close(near.values.roughness, [0.3], tolerance=1e-4)
    close(far.normal, [[0.0, 1.0, 0.0]], tolerance=1e-4)
    # The variance of von Mises and Fisher's distribution whose mean has the length .8.
    close(far.values.roughness, [(0.3**4 + 2 * 0.36 / (0.8 * (3 - 0.64))) ** 0.25], tolerance=1e-4)
    close(far.log_roughness, np.log(far.values.roughness), tolerance=1e-5)


def test_an_image_may_be_a_normal_map_and_a_color_at_once(close):
    ball = part("a", TexturedMaterial(), 0)
    texel = image(4, 4, 3)
    both = TexturedMaterial(1.0, 0.0, 0.5, base_color_texture=Texture(texel), normal_texture=Texture(texel))
    plain = dataclasses.replace(both, normal_texture=None)
    pair = [dataclasses.replace(ball, material=each) for each in (both, plain)]
    look, count = material_table.of_parts(pair).at_vertices(), len(ball.mesh.position)
    close(look.values.base_color[:count], look.values.base_color[count : 2 * count])
    close(look.normal[count : 2 * count], ball.mesh.normal, tolerance=1e-5)
    assert material_table.of_parts(pair[1:]).at_vertices().normal is None


def test_vertices_without_usable_tangents_have_finite_normals():
    ball = part("a", TexturedMaterial(), 0).mesh
    along = np.array(ball.normal) * np.arange(len(ball.normal))[:, None]  # zero at first, parallel to the normal then
    mesh = dataclasses.replace(ball, tangent=jnp.asarray(along))
    normal = bumpy(mesh, image(4, 4, 3), normal_scale=2.0).at_vertices().normal
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-5)
