"""A package from outside, whose modules are the blocks of docs/extending.md: a system, its recipe, and a BRDF."""

import dataclasses
import importlib
import inspect
import json
import pathlib
import re
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import GGX
from jaxprt.cli import inputs
from jaxprt.cli.main import program
from jaxprt.files import extensions
from jaxprt.relit import measuring, paths, registry, sampling
from jaxprt.relit.channels import Shading
from jaxprt.scene import TexturedMaterial, builtin
from jaxprt.view import Session, export
from tests.systems import test_protocol as protocol

pytestmark = pytest.mark.usefixtures("coarse")

PAGE = (pathlib.Path(__file__).parents[1] / "docs" / "extending.md").read_text()
MODULES = dict(re.findall(r"```python\n# (\w+)\.py\n(.*?)```", PAGE, re.DOTALL))
ENTRIES = re.findall(r"```toml\n\[project\.entry-points\.(\w+)\]\n(.*?)```", PAGE, re.DOTALL)
EYE = np.array([2.0, 2.5, 3.0])
SIZE = 8


def install(folder, modules, entries):
    """What an installer leaves of a package: modules, and the metadata with its entry points."""
    for name, source in modules.items():
        (folder / f"{name}.py").write_text(source)
    metadata = folder / "outside-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (metadata / "entry_points.txt").write_text("\n".join(["[jaxprt]", *lines]))


@pytest.fixture(autouse=True, scope="module")
def forgotten():
    """What is registered here is known to no other file."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((registry, "SYSTEMS"), (registry, "MATERIALS"), (extensions, "CLASSES")):
            patch.setattr(module, name, dict(getattr(module, name)))
        yield patch
    extensions.discover.cache_clear()


@pytest.fixture(scope="module")
def installed(forgotten, tmp_path_factory):
    """The folder of the installed package, which no test imports."""
    folder = tmp_path_factory.mktemp("outside")
    ((group, lines),) = ENTRIES
    assert group == extensions.GROUP
    install(folder, MODULES, dict(re.findall(r'(\w+) = "(\w+)"', lines)))
    forgotten.syspath_prepend(folder)
    extensions.discover.cache_clear()
    yield folder
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def metal(installed):
    """The class of the outside BRDF."""
    return registry.materials()["alpha-ggx"]


@pytest.fixture(scope="module")
def light():
    return builtin.daylight(size=SIZE)


@pytest.fixture(scope="module")
def scene(metal):
    """A metal ball over a glossy ground."""
    ball = builtin.sphere(rings=6, sectors=8)
    ground = prt.scene.mesh.ground_plane(ball, vertices=49)
    camera = prt.Camera(EYE, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.8, 32, 24)
    glossy = TexturedMaterial(base_color=(0.6, 0.5, 0.4), roughness=0.5)
    return prt.Scene(
        [prt.Part("ball", ball, metal([0.9, 0.6, 0.3], 0.3)), prt.Part("ground", ground, glossy)], [camera]
    )


@pytest.fixture(scope="module")
def relit(scene):
    return prt.precompute(scene, system="texels", size=SIZE, refine=False, progress=False)


def test_a_metal_of_alpha_is_the_ggx_of_its_square_root_and_is_widened(metal):
    wi, wo = (jax.random.normal(jax.random.key(n), (64, 3)) for n in range(2))
    wi, wo = (w.at[:, 2].set(jnp.abs(w[:, 2])) / jnp.linalg.norm(w, axis=1, keepdims=True) for w in (wi, wo))
    same = GGX(f0=1.0, roughness=0.3**0.5)
    np.testing.assert_allclose(metal(1.0, 0.3)(wi, wo), same(wi, wo), rtol=2e-5)
    assert paths.widened(metal(1.0, 0.01)).alpha == np.float32(0.09)
    assert paths.widened(metal(1.0, 0.3)).alpha == np.float32(0.3)


# All promises but those at sizes for `make test-long`, and that of systems that take lights of one size alone.
PROMISES = [
    test
    for name, test in vars(protocol).items()
    if protocol.each_system.mark in getattr(test, "pytestmark", ())
    and "sizes" not in name
    and "lights_of_another_size" not in name
]
PROMISES += [
    protocol.test_a_blend_weights_the_channels_of_each_vertex,
    protocol.test_lights_of_two_or_four_colors_are_refused_by_number_where_the_materials_have_three,
]


@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__)
def test_the_system_keeps_the_promises_of_all_systems(promise, installed, monkeypatch, request):
    recipe = registry.systems()["texels"]

    def make(name, model):
        mesh = protocol.mesh(name)
        target = prt.relit.recipes.Target(mesh, run=prt.Run(progress=False))
        return recipe.make(Shading(mesh, protocol.MODELS[model], protocol.MODELS[model]), target), None

    monkeypatch.setitem(protocol.SYSTEMS, "texels", protocol.Promise(make, 0.02, 0.1))
    monkeypatch.setitem(protocol.EXPORTED, "texels", 0.25)
    for mark in promise.pytestmark:
        if mark.name == "usefixtures":
            request.getfixturevalue(*mark.args)
    fixtures = [name for name in inspect.signature(promise).parameters if name != "name"]
    promise("texels", **{name: request.getfixturevalue(name) for name in fixtures})


def test_pictures_show_a_brdf_that_cannot_change_and_a_material(relit, light):
    assert [shading.blend is None for shading in relit.shading] == [True, False]
    picture = np.asarray(relit.picture(light))
    shown = np.asarray(relit.coverage()) == 1
    assert shown.mean() > 0.2
    assert np.all(picture[shown] > 0)
    first, second = (
        relit.picture(light, materials={"ground": TexturedMaterial(base_color=color, roughness=0.8)})
        for color in (0.2, 0.6)
    )
    assert np.mean(second) > 1.2 * np.mean(first)


def test_what_is_saved_is_loaded_without_an_import_by_the_reader(relit, light, tmp_path):
    prt.files.save(tmp_path / "a.prt", relit)
    before = [extensions.CLASSES.pop(name) for name in list(extensions.CLASSES)]
    for name in MODULES:
        del sys.modules[name]
    extensions.discover.cache_clear()
    same = prt.files.load(tmp_path / "a.prt")
    assert type(same.part_system(1)).__name__ == "TexelSum"
    assert type(same.part_system(1)) not in before
    np.testing.assert_array_equal(same.radiance(light, eye=EYE), relit.radiance(light, eye=EYE))


def test_plans_try_the_system_and_choose_it_where_its_error_suffices(scene, light, monkeypatch, tmp_path):
    for module in (measuring, sampling):
        monkeypatch.setattr(module, "POINTS", 200)
        monkeypatch.setattr(module, "FEWEST", 40)
    monkeypatch.setattr(registry, "SYSTEMS", {"texels": registry.systems()["texels"]})
    ground = dataclasses.replace(scene, parts=scene.parts[1:])
    options = {"environments": [light], "rate": 1e-3, "refine": False, "path": tmp_path, "progress": False}
    plan = prt.plan(ground, error=0.1, **options)
    (group,) = plan.group
    assert str(group.chosen.recipe) == "Texels()"
    prt.files.save(tmp_path / "plan.prt", plan)
    assert str(prt.files.load(tmp_path / "plan.prt")) == str(plan)


def test_the_viewer_shows_it(relit, light):
    session = Session(relit, environments={"sky": light})
    look = {"system": "system", "light": 0, "turn": 0.0, "lamps": [], "eye": EYE.tolist(), "target": [0.0, 0.0, 0.0]}
    look |= {"field_of_view": 0.7, "bounces": True, "materials": {}, "stops": None, "viewer": "one", "seq": 1}
    reply = session.answer({"kind": "look", **look})
    assert reply.content["kind"] == "color"
    color = reply.content["scale"] * np.frombuffer(reply.buffers[0], np.float16).astype(float).reshape(-1, 3)
    np.testing.assert_allclose(color, relit.radiance(light, eye=EYE), rtol=2e-3, atol=2e-3)


def test_pages_show_what_the_system_says(relit, light, tmp_path):
    piece = export(relit, tmp_path / "a.html", environments={"sky": light})
    assert piece.degree == 4
    assert piece.error < 0.35  # by harmonics, under a sun


def test_commands_take_the_names(installed, monkeypatch, tmp_path, capsys):
    square = "v -1 0 -1\nv -1 0 1\nv 1 0 1\nv 1 0 -1\nf 1 2 3\nf 1 3 4\n"
    (tmp_path / "mesh.obj").write_text(square)
    page = tmp_path / "a.html"
    given = ["export", tmp_path / "mesh.obj", "--refine", "off", "--light-size", SIZE, "--system", "texels"]
    given = [*map(str, given), "--brdf", "alpha-ggx:alpha=.5", "--error", ".2", "--output", str(page), "--json"]
    with pytest.raises(SystemExit) as end:
        program(given)
    assert not end.value.code
    (row,) = json.loads(capsys.readouterr().out)
    assert row["error"] < 0.2  # of pixels, with the light of harmonics
    monkeypatch.setattr(sys.modules["texels"], "MOST", 3)
    with pytest.raises(SystemExit) as end:
        program(given)
    assert end.value.code == 2
    assert "a sum over texels must be of at most 3 vertices, got 4" in capsys.readouterr().err
    assert inputs.parse("alpha-ggx:alpha=.2").alpha == np.float32(0.2)


class Outside(eqx.Module):
    """A data class that is not registered."""

    value: float = 1.0


class Plain:
    """No data class."""

    def __call__(self, wi, wo):
        return wi


class NoPlan(prt.relit.Recipe):
    """A recipe with a class that is no data class."""

    classes = (Plain,)

    def make(self, shading, target, *, vertices=None):
        raise NotImplementedError


class Other(prt.relit.Recipe):
    """A recipe whose system nobody can ask for by its name."""

    def make(self, shading, target, *, vertices=None):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("name", "extension", "error", "told"),
    [
        ("a b", Other(), ValueError, "must consist of a-z, 0-9, - and _, with a letter first, got 'a b'"),
        (3, Other(), ValueError, "with a letter first, got"),
        (
            "lobe",
            Other(),
            ValueError,
            "the name 'lobe' belongs to jaxprt: register tests.test_extending:Other by another",
        ),
        ("planned", Other(), ValueError, "the name 'planned' belongs to jaxprt"),
        ("ggx", GGX, ValueError, "the name 'ggx' belongs to jaxprt"),
        ("texels", Other(), ValueError, "the name 'texels' belongs to texels:Texels"),
        ("other", Other, TypeError, r"got the class Other: register Other\(\)"),
        ("other", lambda wi, wo: wi, TypeError, "must be a recipe, such as jaxprt.relit.Lobes"),
        ("other", prt.lobe.LobeSystem, TypeError, "got the class LobeSystem"),
        ("other", Plain, TypeError, "must consist of data classes, such as equinox.Module, got Plain"),
        ("other", NoPlan(), TypeError, "must consist of data classes, such as equinox.Module, got Plain"),
    ],
)
def test_what_cannot_be_registered_is_refused_by_name(name, extension, error, told, installed, unchecked):
    known = dict(registry.systems()), dict(registry.materials()), dict(extensions.CLASSES)
    with pytest.raises(error, match=told):
        prt.register(name, extension)
    assert known == (registry.SYSTEMS, registry.MATERIALS, extensions.CLASSES)


def test_a_class_that_is_defined_again_takes_its_name_anew(installed):
    recipe = registry.systems()["texels"]
    prt.register("texels", type(recipe)())
    assert registry.systems()["texels"] is not recipe


def test_files_take_no_class_that_is_not_registered_and_import_nothing(installed, tmp_path, monkeypatch):
    with pytest.raises(TypeError, match=r"got a Outside, whose package must call jaxprt\.register for it"):
        prt.files.save(tmp_path / "a.prt", Outside())
    monkeypatch.setitem(extensions.CLASSES, extensions.full_name(Outside), Outside)
    prt.files.save(tmp_path / "a.prt", Outside())
    assert prt.files.load(tmp_path / "a.prt") == Outside()
    (tmp_path / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(Outside, "__module__", "trap")
    monkeypatch.setitem(extensions.CLASSES, "trap:Outside", Outside)
    prt.files.save(tmp_path / "b.prt", Outside())
    for name in [name for name, kind in extensions.CLASSES.items() if kind is Outside]:
        monkeypatch.delitem(extensions.CLASSES, name)
    with pytest.raises(
        ValueError, match=r"names the module 'trap', of which no class is registered.*: import the package"
    ):
        prt.files.load(tmp_path / "b.prt")
    assert "trap" not in sys.modules


def test_an_extension_that_fails_is_left_out_with_a_warning(forgotten, tmp_path, monkeypatch):
    install(tmp_path, {"broken": "1 / 0"}, {"broken": "broken"})
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda group: [*importlib.metadata.distribution("outside").entry_points]
    )
    monkeypatch.syspath_prepend(tmp_path)
    extensions.discover.cache_clear()
    with pytest.warns(UserWarning, match="the extension 'broken' of jaxprt is left out: division by zero"):
        assert "lobe" in registry.systems()


def test_parts_and_systems_that_have_no_answer_are_refused_by_name(scene, monkeypatch, unchecked):
    monkeypatch.setattr(sys.modules["texels"], "MOST", 40)
    with pytest.raises(ValueError, match="part 'ball': a sum over texels must be of at most 40 vertices, got 42"):
        prt.precompute(scene, system="texels", size=SIZE, refine=False, progress=False)
    with pytest.raises(TypeError, match="the system must be of class Recipe"):
        prt.precompute(scene, system=Outside(), size=SIZE, refine=False, progress=False)
    with pytest.raises(ValueError, match=r"one of dynamic, harmonic, lobe, separable, texels, got 'texel'"):
        prt.precompute(scene, system="texel", size=SIZE, refine=False, progress=False)
