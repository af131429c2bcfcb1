"""Plans against the error that carrying them out has, under lights and from views that they did not see."""

import dataclasses
import importlib
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import lobe, reference
from jaxprt.brdf import AshikhminShirley, Lambert, Ward, WardDuer
from jaxprt.relit import Clusters, Harmonics, Lobes, recipes, reflection
from jaxprt.scene import Environment, TexturedMaterial, builtin
from jaxprt.scene.material import Texture
from jaxprt.scene.mesh import ground_plane, make_mesh

measuring = importlib.import_module("jaxprt.relit.measuring")
sampling = importlib.import_module("jaxprt.relit.sampling")
planning = importlib.import_module("jaxprt.relit.planning")
build = importlib.import_module("jaxprt.relit.build")
ASKED = 0.3
VIEWS = jnp.array([[0.5, 3.0, 1.0], [-2.0, 0.5, 2.5]])


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Few steps and small maps."""
    with pytest.MonkeyPatch.context() as patch:
        terms = tuple(Clusters(step.terms, 12, *list(vars(step).values())[2:]) for step in recipes._CLUSTERS[:3])
        patch.setattr(recipes, "_CLUSTERS", terms)
        patch.setattr(recipes, "_LOBES", recipes._LOBES[:2])
        patch.setattr(recipes, "_HARMONIC", (Harmonics(degree=2),))
        patch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)  # No plan reads it.
        bound(patch, lobe.tabulate, resolution=8)
        patch.setattr(measuring, "_PICTURE", 32)
        patch.setattr(measuring, "_PIXELS", 30)
        # The sums that judge take longest here, where they are compiled without optimization.
        views = measuring.views_around
        for module in (measuring, planning):
            patch.setattr(module, "views_around", lambda mesh: views(mesh)[1::3])
        for module in (measuring, sampling):
            patch.setattr(module, "POINTS", 200)
            patch.setattr(module, "FEWEST", 40)
        yield


@pytest.fixture(scope="module")
def scene():
    ball = builtin.sphere(rings=6, sectors=8)
    ground = ground_plane(ball, vertices=49)
    paint = TexturedMaterial(base_color=np.array([0.6, 0.4, 0.2]), metallic=0.3, roughness=0.5)
    parts = [prt.Part("ball", ball, AshikhminShirley(nu=8, nv=20)), prt.Part("ground", ground, Lambert(0.5))]
    return prt.Scene([*parts, prt.Part("paint", builtin.plane(cells=3), paint)])


@pytest.fixture(scope="module")
def sky():
    return builtin.daylight(size=8)


@pytest.fixture(scope="module")
def planned(scene, sky):
    return prt.plan(scene, refine=False, environments=[sky], error=ASKED, rate=1e-3, progress=False)


@pytest.fixture(scope="module")
def ready(scene, planned):
    return prt.precompute(scene, refine=False, system=planned.recipes, size=8, progress=False)


def test_the_error_asked_for_holds_from_other_views_and_under_another_light(scene, sky, planned, ready):
    assert planned.error * planning.MARGIN <= ASKED
    other = Environment(sky.radiance[:, ::-1] ** 0.8)
    for light, eye in zip((sky, other), VIEWS, strict=True):
        now, options = ready.radiance(light, eye=eye), {"eye": eye, "occluder": scene.mesh}
        exact = np.concatenate([reference.radiance(s.mesh, s.exact, light, **options) for s in ready.shading])
        assert np.linalg.norm(now - exact) < 1.25 * ASKED * np.linalg.norm(exact)


def test_the_report_has_the_error_of_every_part(scene, sky, planned, ready):
    found = ready.report([sky, Environment(jnp.ones((6, 8, 8, 3)))])
    alone = {name: group for group in planned.group for name in group.names}
    assert [(each.name, each.vertices) for each in found.part] == [(n, alone[n].vertices) for n in planned.names]
    for each in found.part:
        part = alone[each.name]
        assert len(each.errors) == len(each.vertex_errors) == 2
        assert 0 < each.vertex_errors[0] < 2 * part.chosen.error + 0.01
        assert each.errors[0] < 2 * (part.chosen.error + part.mesh_error) + 0.05
    assert 0 < found.uncertainty[0] < found.errors[0] < 1
    assert found.nbytes == ready.nbytes
    assert 0 < found.interpolation_error < 1
    assert str(found).count("off by") == 5


def test_the_smallest_that_meets_the_error_at_the_rate_is_chosen(planned, ready):
    for group in planned.group:
        good = [each for each in group.considered if each.error * planning.MARGIN <= ASKED]
        assert group.chosen.nbytes == min(each.nbytes for each in good)
    assert planned.nbytes == pytest.approx(ready.nbytes, rel=0.2)
    assert planned.seconds > 0
    # What is matte is lit by transfer vectors, which need less than any lobes.
    assert isinstance(planned.recipes["ground"], Harmonics)
    assert isinstance(ready.part_system(1), prt.harmonic.DiffuseSystem)
    considered = next(group.considered for group in planned.group if "ground" in group.names)
    assert not any(isinstance(each.recipe, Lobes) for each in considered)


def test_the_table_names_every_part_marks_one_choice_of_each_and_tells_what_bounces_bring(planned, tmp_path):
    table = str(planned)
    prt.files.save(tmp_path / "plan", planned)
    assert str(prt.files.load(tmp_path / "plan")) == table
    assert table.count("*") == 3
    assert all(f"{name}: " in table for name in ("ball", "ground", "paint"))
    assert f"in all: {100 * planned.error:.1f} %" in table
    assert "slower" not in table
    assert table.count("% of shadows between its vertices") == 3
    assert planned.reflected.shape == (3, 3)
    assert np.all(np.diff(planned.reflected, axis=0) < 0)
    assert planned.bounces == 0
    assert reflection.needed(planned.reflected, planned.reflected.max() - 1e-3) == 1
    assert f"ground: {100 * planned.reflected[0, 1]:.1f} % of its light is reflected" in table


def test_a_rate_that_nothing_reaches_takes_the_fastest_and_says_so(scene, sky):
    part = prt.Scene([scene["ground"]])
    found = prt.plan(part, refine=False, environments=[sky], error=ASKED, rate=1e9, progress=False)
    good = [each for each in found.group[0].considered if each.error * planning.MARGIN <= ASKED]
    assert found.group[0].chosen.seconds == min(each.seconds for each in good)
    assert "slower than the 1e+09 frames per second asked for" in str(found)


def test_without_an_error_the_nearest_system_is_taken_with_a_warning(scene, sky, tmp_path, monkeypatch):
    part = prt.Scene([scene["ground"]])
    for module in (planning, build):
        monkeypatch.setattr(module, "ERROR", 1e-6)
    options = {"environments": [sky], "path": tmp_path, "progress": False}
    with pytest.warns(
        UserWarning, match=r"no system reaches an error of 0.0001 % for part 'ground': Harmonics.* is chosen"
    ):
        ready = prt.precompute(part, refine=False, **options)
    found = prt.files.load(tmp_path / "plan")
    assert found.asked == 1e-6
    assert found.group[0].chosen.error == min(each.error for each in found.group[0].considered)
    assert ready.part_system(0).vertices == len(scene["ground"].mesh.position)
    with pytest.raises(ValueError, match=r"part must be the index of one of \d+ parts, got -1"):
        ready.part_system(-1)
    prt.precompute(part, refine=False, **options)  # The kept plan serves again,
    with pytest.raises(ValueError, match="error must be at least"):  # but not one who insists.
        prt.precompute(part, refine=False, error=1e-6, **options)


def test_a_folder_keeps_the_plan_and_refuses_another(scene, sky, tmp_path, monkeypatch):
    far = (512345.0, 0.0, 4987654.0)
    ground = dataclasses.replace(scene["ground"], mesh=dataclasses.replace(scene["ground"].mesh, origin=far))
    part, eye = prt.Scene([ground]), np.add(VIEWS[0], far)
    options = {"environments": [sky], "path": tmp_path / "kept", "progress": False}
    first = prt.precompute(part, refine=False, error=ASKED, **options)
    monkeypatch.setattr(planning, "_candidates", None)  # Nothing is measured again.
    again = prt.precompute(part, refine=False, error=ASKED, **options)
    np.testing.assert_array_equal(first.radiance(sky, eye=eye), again.radiance(sky, eye=eye))
    with pytest.raises(ValueError, match=r"was made for an error of 0\.3 .*, got 0\.2 .*: name another path"):
        prt.precompute(part, refine=False, error=0.2, **options)
    darker = Environment(0.5 * sky.radiance)
    painted = prt.Scene([prt.Part("ground", part.parts[0].mesh, Lambert(0.4))])
    for other, lights in ((part, [darker]), (painted, [sky])):
        with pytest.raises(ValueError, match="made for another scene, other materials or other lights"):
            prt.precompute(other, refine=False, error=ASKED, **options | {"environments": lights})


class Masked(eqx.Module):
    """A BRDF with a function among what JAX does not trace."""

    mask: Callable = eqx.field(static=True)

    def __call__(self, wi, wo):
        """Value in 1/sr."""
        return self.mask(wi) * Lambert(0.5)(wi, wo)


def half(wi):
    """A gray of one half."""
    return 0.5 + 0 * wi[..., :1]


def gray():
    """A function that is made anew by each call."""
    return lambda wi, wo=None: half(wi)


def test_the_key_of_a_plan_knows_classes_and_textures_of_materials_and_functions_by_name(sky):
    plane = builtin.plane(cells=1)
    mesh = make_mesh(plane.position, plane.face, texture=np.asarray(plane.position)[:, [0, 2]])

    def key(material, name="plane"):
        return planning.key_of(prt.Scene([prt.Part(name, mesh, material)]), [sky])

    def wood(**options):
        return TexturedMaterial(base_color_texture=Texture(jnp.full((2, 2, 3), 0.5), **options))

    brushed = {"diffuse": 0.3, "specular": 0.2, "along": 0.3, "across": 0.4}
    made = [gray(), gray()]
    same = [
        (Ward(**brushed), Ward(**brushed)),
        (wood(), wood()),
        tuple(made),
        tuple(Masked(each) for each in made),
    ]
    other = [
        (Ward(**brushed), WardDuer(**brushed)),
        (wood(), wood(wrap=("clamp", "clamp"))),
        (made[0], half),
        (Masked(made[0]), Masked(half)),
    ]
    assert made[0] is not made[1]
    assert all(key(first) == key(second) for first, second in same)
    assert all(key(first) != key(second) for first, second in other)
    assert key(Lambert(0.5)) != key(Lambert(0.5), name="wall")


def test_a_plan_that_was_stopped_goes_on_with_what_was_measured(scene, sky, tmp_path, monkeypatch):
    ground = prt.Scene([scene["ground"]])
    options = {"environments": [sky], "error": 0.02, "path": tmp_path / "plan", "progress": False}
    measure, measured = sampling.Sample.measure, []

    def stopped(sample, recipe):
        if measured:
            raise InterruptedError
        measured.append(recipe)
        return measure(sample, recipe)

    def counted(sample, recipe):
        measured.append(recipe)
        return measure(sample, recipe)

    monkeypatch.setattr(sampling.Sample, "measure", stopped)
    with pytest.raises(InterruptedError):
        prt.plan(ground, refine=False, **options)
    monkeypatch.setattr(sampling.Sample, "measure", counted)
    found = prt.plan(ground, refine=False, **options)
    assert [each.recipe for each in found.group[0].considered] == measured
    assert len(measured) > 1
    assert str(prt.plan(ground, refine=False, **options)) == str(found)
    assert len(measured) == len(found.group[0].considered)
    prt.plan(ground, refine=False, **options | {"environments": [Environment(2 * sky.radiance)]})
    assert len(measured) == 2 * len(found.group[0].considered)


def test_a_scenes_own_lights_are_planned_for(scene, sky):
    assert measuring.lights_of(prt.Scene(scene.parts, environments=[sky])) == (sky,)
    assert len(measuring.lights_of(scene)) == 2


WHITE = Environment(jnp.ones((6, 8, 8, 3)))
DAMAGED = jax.tree.map(lambda each: each.at[2, 3, 4, 1].set(jnp.nan), WHITE)  # as a wrong computation makes it
WRONG = [
    ({"environments": []}, "environments must be at least one, got none"),
    ({"environments": [WHITE, Environment(jnp.ones((6, 4, 4, 3)))]}, "must all have the same size"),
    (
        {"environments": [WHITE, DAMAGED]},
        r"environment 1 must be finite, got 1 of 1152 .* first at \(2, 3, 4, 1\)",
    ),
    ({"environments": [WHITE, 3]}, "environment 1 must be of class Environment"),
    ({"error": 0.0}, "error must be positive and finite, got 0"),
    ({"error": np.nan}, "error must be positive and finite, got nan"),
    ({"error": 1e-5}, r"error must be at least 0\.\d+ for part 'ground', which .* reaches; got 1e-05"),
    ({"rate": np.inf}, "rate must be positive and finite, got inf"),
]


@pytest.mark.usefixtures("unchecked")
def test_impossible_plans_are_refused(scene, sky):
    ground, common = prt.Scene([scene["ground"]]), {"environments": [sky], "refine": False, "progress": False}
    for options, message in WRONG:
        with pytest.raises((TypeError, ValueError), match=message):
            prt.plan(ground, **common | options)
    broken = prt.Scene([prt.Part("broken", scene["ground"].mesh, lambda wi, wo: jnp.nan * wi[..., :1])])
    with pytest.raises(ValueError, match=r"the radiance that the BRDF reflects, .* must be finite, got"):
        prt.plan(broken, **common)
