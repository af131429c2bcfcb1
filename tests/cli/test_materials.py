"""Materials as the command line names them, against the classes and loaders of the package."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import measured
from jaxprt.cli import inputs
from jaxprt.relit import registry

WI, WO = np.array([[0.6, 0.0, 0.8], [0.0, 0.28, 0.96]]), np.array([[-0.36, 0.48, 0.8], [0.0, -0.28, 0.96]])
PAIR = jnp.asarray(WI, jnp.float32), jnp.asarray(WO, jnp.float32)
NGAN = (
    "# fits\n"
    "a-metal = Aggregate(Lambertian(albedo = [0.1, 0.2, 0.3]), {model}(albedo = [0.3, 0.2, 0.1], {more}))\n"
    "another = Aggregate(Lambertian(albedo = [0, 0, 0]), {model}(albedo = [0.5, 0.5, 0.5], {more}))\n"
)
SCALE = np.array([1, 1.15, 1.66])


def evaluated(brdf):
    """Values at the pair of directions, by one program."""
    return np.asarray(jax.jit(lambda model, wi, wo: model(wi, wo))(brdf, *PAIR))


def same(made, expected):
    """Asserts that two BRDFs are of one class and have the same arrays."""
    assert type(made) is type(expected)
    jax.tree.map(np.testing.assert_array_equal, made, expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("lambert", prt.brdf.Lambert()),
        ("lambert:albedo=.1/.2/.3", prt.brdf.Lambert([0.1, 0.2, 0.3])),
        ("ashikhmin-shirley:nu=10,nv=20", prt.brdf.AshikhminShirley(nu=10, nv=20)),
        ("ward:diffuse=.1,specular=.3,alpha_x=.1,alpha_y=.3", prt.brdf.Ward(0.1, 0.3, 0.1, 0.3)),
        ("cook-torrance:roughness=.3,f0=.9/.8/.1", prt.brdf.CookTorrance(roughness=0.3, f0=[0.9, 0.8, 0.1])),
        (
            "lafortune:diffuse=.1,cx=-1:-.8,cy=-1:-.8,cz=.9:.5,exponent=20:5",
            prt.brdf.Lafortune(0.1, [-1, -0.8], [-1, -0.8], [0.9, 0.5], [20, 5]),
        ),
        ("ggx:roughness=.2:.5,rotation=.3", prt.brdf.GGX(roughness=[0.2, 0.5], rotation=0.3)),
        ("ggx-interface:eta=.2/.9/1.5,k=3", prt.brdf.GGXInterface(eta=[0.2, 0.9, 1.5], k=3)),
    ],
)
def test_a_model_by_its_name_and_numbers_is_that_model(text, expected):
    same(inputs.parse(text), expected)


def test_every_model_of_the_package_has_a_name_and_the_material_of_gltf_can_change():
    models = {
        each for each in vars(prt.brdf).values() if isinstance(each, type) and issubclass(each, prt.brdf.models.Model)
    }
    named = {*registry.MATERIALS.values(), prt.brdf.MetallicRoughness, prt.brdf.SchlickDiffuse}
    assert models <= named
    words = {name: "".join(name.split("-")) for name in registry.MATERIALS}
    same_name = [name for name, word in words.items() if registry.MATERIALS[name].__name__.lower() == word]
    assert set(registry.MATERIALS) - set(same_name) == {"metallic-roughness"}
    made = inputs.parse("metallic-roughness:base_color=.9/.6/.2,metallic=0,roughness=.3")
    assert isinstance(made, prt.scene.TexturedMaterial)
    assert inputs.describe(made)["base_color"] == pytest.approx([0.9, 0.6, 0.2])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("velvet", "must be one of lambert, .*, merl, .* got 'velvet'"),
        ("ward:gloss=1", "ward takes diffuse=, specular=, along=, across=, got 'gloss=1'"),
        ("ward:.3", "ward takes .* got '.3'"),
        ("ward:along=.1,alpha_x=.2", "each parameter once, got along twice"),
        ("ward:diffuse=.1/.2", "diffuse of ward must be numbers, or colors as .1/.2/.3, got '.1/.2'"),
        ("ward:diffuse=.1:.2", "diffuse of ward must be one value, got '.1:.2'"),
        ("ward:diffuse=-1", "diffuse of Ward must be at least 0"),
        ("lafortune:diffuse=.1", "lafortune must have cx=, cy=, cz=, exponent="),
        ("merl", "merl must name a file, merl:FILE, got none"),
        ("npf:table.bin,gloss=3", r"npf takes npf:FILE,material=..\[,names=..\], got 'gloss=3'"),
        ("scattered:x.brdf,smoothing=few", "smoothing of scattered must be a finite number, got 'few'"),
    ],
)
def test_what_is_no_material_is_refused_by_what_was_required_and_what_came(text, words):
    with pytest.raises(ValueError, match=words):
        inputs.parse(text)


@pytest.mark.parametrize(
    ("model", "more", "lobe"),
    [
        (
            "NganCookTorrance",
            "eta = 0.4, roughness = 0.3",
            lambda ks: evaluated(prt.brdf.CookTorrance(0, ks, 0.3, 0.4)),
        ),
        ("NganWardDuer", "roughness = 0.3", lambda ks: evaluated(prt.brdf.WardDuer(0, ks, 0.3, 0.3))),
        # As the paper and BBM write them.
        ("NganBlinnPhong", "sharpness = 9.0", lambda ks: ks * 11 / (2 * np.pi) * half_cosine() ** 9),
        (
            "NganLafortune",
            "Cxy = -0.6, Cz = 0.5, sharpness = 9.0",
            lambda ks: ks * 11 / (2 * np.pi * 0.6**9) * np.sum([-0.6, -0.6, 0.5] * WI * WO, -1)[:, None] ** 9,
        ),
    ],
)
def test_fits_of_ngan_are_the_published_lobes_in_the_colors_of_merl(tmp_path, model, more, lobe):
    path = tmp_path / "ngan.fit"
    path.write_text(NGAN.format(model=model, more=more))
    made = inputs.parse(f"ngan:{path},material=a-metal")
    expected = np.array([0.1, 0.2, 0.3]) * SCALE / np.pi + lobe(np.array([0.3, 0.2, 0.1]) * SCALE)
    np.testing.assert_allclose(evaluated(made), expected, rtol=1e-4)


def half_cosine():
    half = WI + WO
    return (half[:, 2] / np.linalg.norm(half, axis=-1))[:, None]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (NGAN.format(model="NganHe", more="roughness = 1"), "must be one of NganBlinnPhong, .* got NganHe"),
        (NGAN.format(model="NganWardDuer", more="sharpness = 1"), "model NganWardDuer: it must have albedo, roughness"),
        ("nothing", "must have lines such as"),
    ],
)
def test_other_fits_are_refused(tmp_path, text, words):
    path = tmp_path / "ngan.fit"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        prt.brdf.load_ngan(path, "a-metal")
    with pytest.raises(ValueError, match=r"one of 2 names such as a-metal.* got 'a-meta'|must have lines such as"):
        prt.brdf.load_ngan(path, "a-meta")


def test_files_of_measurements_are_read_by_their_loaders(data):
    folder = data / "brdf"
    npf, names = folder / "merl_npf_512x256_rgb32f.bin", folder / "merl_npf_materials.txt"
    for text, expected in (
        (f"npf:{npf},material=nickel", prt.brdf.load_npf(npf, "nickel")),
        (f"npf:{npf},material=nickel,names={names}", prt.brdf.load_npf(npf, "nickel")),
        (
            f"lafortune:{folder / 'lafortune_measured.json'},material=clay",
            prt.brdf.load_lafortune(folder / "lafortune_measured.json", "clay"),
        ),
        (
            f"ngan:{folder / 'ngan2005_wardduer.fit'},material=nickel",
            prt.brdf.load_ngan(folder / "ngan2005_wardduer.fit", "nickel"),
        ),
    ):
        same(inputs.parse(text), expected)
    with pytest.raises(ValueError, match="one of 100 names such as nickel"):
        inputs.parse(f"npf:{npf},material=nickle")
    # The file and the table of the 86 fits of Cook-Torrance's model say the same.
    family = prt.brdf.navigation.cook_torrance(path=folder / "ngan2005_cooktorrance.csv")
    number = family.name.index("nickel")
    made = prt.brdf.load_ngan(folder / "ngan2005_cooktorrance.fit", "nickel")
    np.testing.assert_allclose(made.specular, family.specular[number], rtol=1e-6)
    np.testing.assert_allclose(
        evaluated(made) - made.diffuse / np.pi,
        family.specular[number] * evaluated(family.brdf[number]),
        rtol=1e-4,
        atol=1e-6,
    )


def test_the_merl_form_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(measured, "_MERL_SHAPE", (2, 2, 4))
    path = tmp_path / "gray.binary"
    path.write_bytes(np.array([2, 2, 4], "<i4").tobytes() + np.full(48, 30.0).astype("<f8").tobytes())
    expected = 30 * SCALE / 1500
    np.testing.assert_allclose(evaluated(inputs.parse(f"merl:{path}")), np.broadcast_to(expected, (2, 3)), rtol=1e-5)
