"""Dictionaries of Mitsuba 3, against Mitsuba itself."""

import mitsuba
import numpy as np
import pytest

from jaxprt import image
from jaxprt.files import write_exr, write_png
from jaxprt.scene import environment, load_scene
from jaxprt.sphere import cubemap

PIXEL = np.random.default_rng(0).uniform(0.1, 0.9, (4, 6, 3)).astype(np.float32)
SQUARE = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 4/4 3/3 2/2\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty float s\n"
)
PLY += "property float t\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
PLY += "-1 0 0 0 0\n1 0 0 1 0\n0 2 0 0.5 1\n3 0 1 2\n"


@pytest.fixture(scope="module")
def mi():
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def move(mi, x, y, z, scale=1.0, flat=0.8):
    return mi.ScalarTransform4f().translate([x, y, z]).rotate([0.6, 0, 0.8], 50).scale([scale, flat * scale, scale])


@pytest.fixture(scope="module")
def dictionary(mi, tmp_path_factory):
    """All shapes in view of one camera, with a bitmap on each."""
    folder = tmp_path_factory.mktemp("mitsuba")
    write_png(folder / "bitmap.png", PIXEL)
    (folder / "square.obj").write_text(SQUARE)
    (folder / "triangle.ply").write_text(PLY)
    bitmap = {"type": "bitmap", "filename": str(folder / "bitmap.png"), "wrap_mode": "mirror"}
    bitmap["to_uv"] = mi.ScalarTransform3f().translate([0.2, 0.1]).scale([1.5, 0.7])
    plain = {"type": "bitmap", "filename": str(folder / "bitmap.png")}
    camera = {
        "type": "perspective",
        **{"fov": 42.0, "fov_axis": "larger", "film": {"type": "hdrfilm", "width": 32, "height": 40}},
        "to_world": mi.ScalarTransform4f().look_at(origin=[1, 3, 9], target=[0.2, 0.1, 0], up=[0.1, 1, 0]),
    }
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "eye": camera,
        "painted": {"type": "diffuse", "reflectance": bitmap},
        "ball": {
            **{"type": "sphere", "center": [0, 0.2, 0], "radius": 1.2, "to_world": move(mi, -1.5, 1.5, 0, 0.9, 1)},
            "bsdf": {"type": "ref", "id": "painted"},
        },
        "box": {
            "type": "cube",
            "to_world": move(mi, 1.5, 1.5, 0, 0.7),
            "bsdf": {"type": "diffuse", "reflectance": plain},
        },
        "sheet": {
            **{"type": "rectangle", "to_world": move(mi, 1.2, -1.5, 0, 1.3), "flip_normals": True},
            "anything": {"type": "diffuse", "reflectance": plain},
        },
        "tile": {
            **{"type": "obj", "filename": str(folder / "square.obj"), "to_world": move(mi, -1.5, -1.5, 1)},
            "bsdf": {"type": "diffuse", "reflectance": bitmap},
        },
        "sail": {
            **{"type": "ply", "filename": str(folder / "triangle.ply"), "to_world": move(mi, -0.5, -2.8, 1)},
            "bsdf": {"type": "diffuse", "reflectance": plain},
        },
    }


def test_shapes_images_and_the_camera_are_where_mitsuba_has_them(mi, dictionary):
    scene, peer = load_scene(dictionary), mi.load_dict(dictionary, optimize=False)
    (camera,), mesh = scene.cameras, scene.mesh
    assert [part.name for part in scene.parts] == ["ball", "box", "sheet", "tile", "sail"]
    assert (camera.width, camera.height) == (32, 40)
    fragments, ray = image.rasterize(mesh, camera), np.asarray(image.ray_direction(camera))
    normal, place = (np.asarray(image.interpolate(fragments, mesh.face, each)) for each in (mesh.normal, mesh.texture))
    region = np.asarray(mesh.region)[np.asarray(mesh.face)[np.asarray(fragments.triangle), 0]]
    region = np.where(np.asarray(fragments.triangle) < 0, -1, region)
    color = np.stack([part.material.at(place).base_color for part in scene.parts])
    shapes = {each.id(): number for number, each in enumerate(peer.shapes())}
    order = [shapes[part.name] for part in scene.parts]
    seen = np.zeros(len(scene.parts), int)
    errors = []
    for row in range(camera.height):
        for column in range(camera.width):
            film = mi.ScalarPoint2f((column + 0.5) / camera.width, (row + 0.5) / camera.height)
            theirs, _ = peer.sensors()[0].sample_ray(0, 0.5, film, [0.5, 0.5])
            np.testing.assert_allclose(ray[row, column], theirs.d, atol=1e-5)
            hit = peer.ray_intersect(theirs)
            number = region[row, column]
            if not hit.is_valid() or number < 0 or peer.shapes()[order[number]] != hit.shape:
                errors.append(hit.is_valid() or number >= 0)
                continue
            seen[number] += 1
            close = np.dot(normal[row, column] / np.linalg.norm(normal[row, column]), hit.sh_frame.n) > 0.999
            expected = np.array(hit.bsdf().eval_diffuse_reflectance(hit))
            errors.append(not close or np.abs(color[number, row, column] - expected).max() > 0.02)
    assert seen.min() > 15
    assert np.mean(errors) < 0.01  # Pixels at edges and seams.


def test_light_from_images_is_turned_and_scaled_as_mitsuba_does(mi, tmp_path):
    smooth = np.random.default_rng(0).uniform(0, 1, (2, 4, 3)).repeat(16, 0).repeat(16, 1).astype(np.float32)
    write_exr(tmp_path / "sky.exr", smooth)
    turn = mi.ScalarTransform4f().rotate([0.6, -0.8, 0], 70)
    sky = {"type": "envmap", "filename": str(tmp_path / "sky.exr"), "scale": 2.5, "to_world": turn}
    scene = {"type": "scene", "sheet": {"type": "rectangle"}, "sky": sky, "gray": {"type": "constant", "radiance": 0.3}}
    light, gray = load_scene(scene).environments
    np.testing.assert_allclose(gray.radiance, np.full((6, 1, 1, 3), 0.3), rtol=1e-6)
    direction = np.asarray(cubemap.direction(size=8)).reshape(-1, 3)
    emitter = mi.load_dict(sky)
    expected = []
    for each in direction:
        hit = mi.SurfaceInteraction3f()
        hit.wi = -each
        expected.append(np.array(emitter.eval(hit)))
    found = np.asarray(environment.background(light, direction))
    assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected)


def one(bsdf, **shape):
    return load_scene({"type": "scene", "sheet": {"type": "rectangle", "bsdf": bsdf} | shape}).parts[0].material


def test_bsdfs_become_metallic_roughness_materials():
    red = {"type": "rgb", "value": [0.5, 0.2, 0.1]}
    diffuse = one({"type": "diffuse", "reflectance": red}, emitter={"type": "area", "radiance": [3, 2, 1]})
    np.testing.assert_allclose(diffuse.base_color, red["value"], rtol=1e-6)
    np.testing.assert_array_equal(diffuse.emissive, [3, 2, 1])
    assert (float(diffuse.metallic), float(diffuse.specular)) == (0, 0)
    gold = {"eta": {"type": "rgb", "value": [0.2, 0.4, 1.5]}, "k": {"type": "rgb", "value": [3.1, 2.4, 1.9]}}
    metal = one({"type": "roughconductor", "distribution": "ggx", "alpha_u": 0.1, "alpha_v": 0.3, **gold})
    index = np.array([0.2, 0.4, 1.5]) + 1j * np.array([3.1, 2.4, 1.9])
    np.testing.assert_allclose(metal.base_color, np.abs((index - 1) / (index + 1)) ** 2, rtol=1e-5)
    alpha = float(metal.roughness) ** 2
    assert alpha == pytest.approx(0.1)
    assert alpha + (1 - alpha) * float(metal.anisotropy) ** 2 == pytest.approx(0.3)
    assert float(metal.rotation) == pytest.approx(np.pi / 2)
    disney = one({"type": "principled", "roughness": 0.5, "anisotropic": 0.8, "metallic": 0.4, "specular": 0.5})
    aspect = np.sqrt(1 - 0.9 * 0.8)
    alpha = float(disney.roughness) ** 2
    assert alpha == pytest.approx(0.25 * aspect)
    assert alpha + (1 - alpha) * float(disney.anisotropy) ** 2 == pytest.approx(0.25 / aspect)
    assert float(disney.ior) == pytest.approx(1.5)
    plastic = one(
        {"type": "roughplastic", "diffuse_reflectance": 0.3, "alpha": 0.04, "int_ior": 1.6, "distribution": "ggx"}
    )
    assert (float(plastic.roughness), float(plastic.ior)) == (pytest.approx(0.2), pytest.approx(1.6 / 1.000277))
    np.testing.assert_allclose(
        load_scene({"type": "scene", "a": {"type": "rectangle"}}).parts[0].material.base_color, 0.5
    )


def test_masks_are_opacities_and_two_sided_backs_are_lit(tmp_path):
    write_png(tmp_path / "hole.png", np.array([[[0.0, 0, 0], [1, 1, 1]]]))

    def one(opacity, **field):
        mask = {"type": "mask", "opacity": opacity, "inner": {"type": "twosided", "a": {"type": "diffuse"}}}
        (part,) = load_scene({"type": "scene", "a": {"type": "rectangle", "bsdf": mask | field}}).parts
        return part.material

    plain = one(0.25)
    assert (plain.alpha_mode, float(plain.alpha), plain.back) == ("blend", 0.25, "lit")
    texture = one({"type": "bitmap", "filename": str(tmp_path / "hole.png"), "raw": True}).alpha_texture
    np.testing.assert_allclose(texture.image[0, :, 0], [0, 1], atol=1e-6)
    inner = {"type": "mask", "opacity": 0.5, "a": {"type": "diffuse"}}
    assert float(one(0.2, inner={"type": "twosided", "a": inner}).alpha) == pytest.approx(0.1)
    masked = {"type": "mask", "opacity": {"type": "bitmap", "filename": str(tmp_path / "hole.png")}}
    both = one(0.5, inner=masked | {"a": {"type": "diffuse"}})
    assert (float(both.alpha), both.alpha_texture is None) == (0.5, False)
    with pytest.raises(ValueError, match="bsdf of a must have one opacity with a bitmap, got one in another"):
        one(masked["opacity"], inner=masked | {"a": {"type": "diffuse"}})


def test_what_has_no_equal_is_said_by_name():
    inner = {"type": "principled", "clearcoat": 0.5, "sheen": 0.0, "anisotropic": 0.2}
    scene = {
        **{"type": "scene", "lamp": {"type": "point"}, "pane": {"type": "disk"}},
        "integrator": {"type": "path", "hide_emitters": True},
        "sheet": {"type": "rectangle", "to_world": np.eye(4).tolist(), "bsdf": {"type": "twosided", "inner": inner}},
    }
    with pytest.warns(UserWarning, match="not supported and ignored") as caught:
        load_scene(scene)
    (message,) = [str(each.message) for each in caught]
    expected = r"clearcoat of bsdf of sheet, hide_emitters of integrator, lamp (point), pane (disk)"
    assert message == f"the dictionary: not supported and ignored are {expected}"


def test_films_and_crops_of_a_sensor_are_read_or_said_by_name():
    film = {"type": "hdrfilm", "width": np.int64(8), "height": 6, "crop_width": 4, "rfilter": {"type": "box"}}
    eye = {"type": "perspective", "fov": 40, "near_clip": 0.1, "principal_point_offset_x": 0.2, "film": film}
    scene = {"type": "scene", "sheet": {"type": "rectangle"}, "eye": eye | {"sampler": {"type": "independent"}}}
    expected = "ignored are crop_width of film of eye, principal_point_offset_x of eye$"
    with pytest.warns(UserWarning, match=expected):
        (camera,) = load_scene(scene).cameras
    assert (camera.width, camera.height) == (8, 6)
    assert 2 * np.arctan(np.tan(np.radians(20)) * 6 / 8) == pytest.approx(float(camera.field_of_view))


LOOP, LOOP_OF_BSDFS = [], {"type": "twosided"}
LOOP.append(LOOP)
LOOP_OF_BSDFS["inner"] = LOOP_OF_BSDFS
TILE, FILM = {"type": "bitmap", "filename": "x.png"}, {"type": "hdrfilm", "width": 8, "height": 8}


def shape(**field):
    return {"sheet": {"type": "rectangle"} | field}


def matte(**field):
    return shape(bsdf={"type": "diffuse"} | field)


def sensor(**field):
    return {"eye": {"type": "perspective", "fov": 40.0} | field}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"type": "shape"}, "must have the type 'scene', got 'shape'"),
        ({"sheet": 3}, "sheet must be a dictionary, got one of class int"),
        ({"sheet": {"type": "disk"}}, "a scene must have at least one part, got none"),
        (matte(type="dielectric"), "bsdf of sheet must be one of .* got 'dielectric'"),
        (shape(bsdf={"type": "ref", "id": "x"}), "sheet must refer to something .* got 'x'"),
        (matte(type="roughconductor"), "must have eta and k or .*, got 'Cu'"),
        ({"sheet": {"type": "rectangle", "to_world": np.eye(3)}}, "to_world of sheet must be a finite 4 x 4 matrix"),
        ({"sheet": {"type": "obj", "filename": "a.ply"}}, r"filename of sheet must end in \.obj, got 'a\.ply'"),
        (matte(reflectance=2), "sheet: base_color .* 0 and 1"),
        (matte(reflectance={"type": "checkerboard"}), "must be a number, a color, or a texture of the type bitmap"),
        ({"eye": {"type": "perspective"}}, "eye must have fov, and no focal_length, got type"),
        ({"sky": {"type": "envmap"}}, "sky must have a filename, got type"),
        ({3: {"type": "cube"}}, "names in a scene must be text, got 3"),
        *[({"sheet": {"type": kind}}, "sheet must have a type, as text, got") for kind in (None, ["cube"])],
        *[(shape(bsdf=x), "bsdf of sheet must be a dictionary with a type, got") for x in (None, [LOOP])],
        *[(shape(bsdf=x), "bsdf of sheet must have a type, as text, got") for x in ({}, {"type": [1]})],
        (shape(bsdf=LOOP_OF_BSDFS), "bsdf of sheet must hold at most 16 BSDFs in each other, got more, or one that"),
        ({"m": {"type": "ref", "id": "m"}} | shape(bsdf={"type": "ref", "id": "m"}), "bsdf of sheet must refer to"),
        (shape(bsdf={"type": "twosided"}), "bsdf of sheet must hold a BSDF, got type"),
        (shape(a={"type": "diffuse"}, b={"type": "diffuse"}), "sheet must have at most one BSDF and one emitter"),
        (shape(to_world=np.zeros((4, 4))), "the last row of to_world of sheet must be zeros and 1, got"),
        (shape(to_world=np.diag([1, 0, 0, 1])), "to_world of sheet must leave the shape an area, got"),
        (shape(flip_normals="false"), "flip_normals of sheet must be True or False, got 'false'"),
        *[(shape(type="sphere", radius=x), "radius of sheet must be .*, got") for x in (0, "1", np.inf)],
        *[(shape(type="sphere", center=x), "center of sheet must be three") for x in ([0, 0], {})],
        (matte(reflectance=LOOP), "reflectance of bsdf of sheet must be a finite number or color, got"),
        (matte(reflectance=TILE | {"filename": None}), "filename of reflectance of bsdf of sheet must be a path"),
        (matte(reflectance=TILE | {"wrap_mode": "x"}), "wrap_mode of .* must be one of repeat, mirror, clamp, got 'x'"),
        (matte(type="plastic", ext_ior=0), "ext_ior of bsdf of sheet must be above 0 and at most"),
        (matte(type="conductor", eta=-1, k=0), "bsdf of sheet must have eta and k of at least 0, got"),
        (matte(type="conductor", material="none", specular_reflectance=2), "sheet: base_color .* between 0 and 1"),
        (matte(type="roughconductor", eta=1, k=1, distribution="x"), "distribution of bsdf of sheet must be one of"),
        *[(sensor(fov=x), "fov of eye must be .*, got") for x in (0, 360, "40")],
        (sensor(fov=180), "eye: the camera's field_of_view must be between"),
        (sensor(film="x"), "film of eye must be a dictionary with a type, got 'x'"),
        *[(sensor(film=FILM | {"width": x}), "width of the film of eye must be .*, got") for x in (0, 8.5)],
        *[(sensor(to_world=np.diag([x, 1, 1, 1])), "to_world of eye must be a pure rotation") for x in (0, -1, 2)],
        *[({"sky": {"type": "constant", "radiance": x}}, "radiance of sky must be") for x in ("x", [1, 2], np.nan)],
        (matte(type="principled", specular=0.5, eta=1.9), "bsdf of sheet must have specular or eta, got both"),
        (matte(reflectance={"type": "rgb", "value": 0.5, "scale": 2}), "must have a type and a value alone, got type"),
        (sensor(film=FILM, other=FILM), "eye must have one film, got two"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*disk")
def test_damaged_dictionaries_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        load_scene({"type": "scene", "sheet": {"type": "rectangle"}} | change)
