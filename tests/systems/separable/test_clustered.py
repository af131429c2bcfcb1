"""Clustered principal components against dense transport and NumPy's singular values."""

import pickle
from concurrent.futures import Executor, Future

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import separable, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import builtin
from jaxprt.scene.mesh import join
from jaxprt.sphere import haar
from jaxprt.systems.separable import SeparableBrdf, factor
from jaxprt.systems.separable.clustered import precompute
from jaxprt.systems.separable.sparse import project
from jaxprt.visibility import members
from jaxprt.visibility.members import cluster

SIZE = 8
ALL = 6 * SIZE**2
VERTICES = 39  # Three clusters of ten, and one of nine that repeats its last.
CLUSTERS, TERMS = 4, 3
WHOLE = {"clusters": CLUSTERS, "components": 10, "modes": 30, "keep": ALL}
SMALL = {"clusters": CLUSTERS, "components": 4, "modes": 8, "keep": 100}
HALF = 2e-3  # Numbers of half precision have 11 bits: modes and cores lose 5e-4 each; measured 3e-4 together.
EYE = jnp.array([1.0, 2.0, 3.0])


def relight(transport, brdf, light):
    return prt.radiance(separable.SeparableSystem(transport, brdf), light, eye=EYE)


@pytest.fixture
def random():
    return np.random.default_rng(2)


@pytest.fixture(scope="module")
def mesh():
    return join([builtin.sphere(rings=5, sectors=7), builtin.plane(cells=2)])


@pytest.fixture(scope="module")
def seen(mesh):
    return visibility.precompute(mesh, size=SIZE)


@pytest.fixture(scope="module")
def brdf():
    return factor(AshikhminShirley(diffuse=[0.3, 0.2, 0.1], specular=0.5, nu=20, nv=80), terms=TERMS, resolution=12)


@pytest.fixture(scope="module")
def exact(seen, brdf):
    """Transport of all vertices uncompressed, [v d r]."""
    level = jnp.asarray(seen.seen(np.arange(VERTICES)))
    return np.asarray(project(level, seen.frame, brdf)[..., 0], np.float64)


@pytest.fixture(scope="module")
def whole(seen, brdf):
    """All components, modes and coefficients."""
    return precompute(seen, brdf, **WHOLE)


@pytest.fixture(scope="module")
def small(seen, brdf):
    return precompute(seen, brdf, **SMALL)


@pytest.fixture(scope="module")
def importance():
    """Rms of natural light by the area of a wavelet, as the module states it."""
    return np.tile(np.asarray(haar.area(size=SIZE), np.float64).ravel(), 6) ** 0.4


def dense(transport):
    """The matrix that it stands for, [q d r], by NumPy in float64 from what is stored."""
    parts = [np.asarray(each, np.float64) for each in (transport.mode, transport.core, transport.weight)]
    value = np.einsum("pkl,plnr,pmn->pmkr", *parts)
    result = np.zeros((*value.shape[:2], transport.rms.shape[0], value.shape[3]))
    for number, index in enumerate(np.asarray(transport.index)):
        result[number][:, index] = value[number]
    return result.reshape(-1, *result.shape[2:])


def by_vertex(transport):
    return dense(transport)[np.asarray(transport.place)]


def best(matrix, rank):
    """The nearest matrix of some rank."""
    u, s, v = np.linalg.svd(matrix, full_matrices=False)
    return (u[:, :rank] * s[:rank]) @ v[:rank]


def same(first, second):
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)


class Strangers(Executor):
    """Workers that know no job until it is sent to them by pickle, and do not take them in order."""

    def __init__(self):
        self.count = 0

    def submit(self, work, key, sent, block):
        """Answers at once."""
        future = Future()
        if sent is not None:
            self.count += 1
        future.set_result(None if sent is None else pickle.loads(sent)[0].run(block))
        return future


def test_all_components_modes_and_coefficients_are_the_uncompressed_transport(whole, exact, close):
    close(by_vertex(whole), exact, tolerance=HALF)
    assert whole.index.shape == (CLUSTERS, ALL)
    assert (whole.mode.shape, whole.core.shape) == ((CLUSTERS, ALL, 30), (CLUSTERS, 30, 10, TERMS))
    assert (whole.weight.shape, whole.terms) == ((CLUSTERS, 10, 10), TERMS)


def test_the_first_components_and_modes_are_the_best_of_their_number(whole, exact, importance, close):
    found = by_vertex(whole.truncate(components=4)) * importance[:, None]
    for vertex in np.asarray(whole.vertex).reshape(CLUSTERS, -1):
        # A repeated vertex counts twice.
        matrix = (exact[vertex] * importance[:, None]).reshape(len(vertex), -1)
        close(found[vertex].reshape(matrix.shape), best(matrix, 4), tolerance=HALF)
    found = by_vertex(whole.truncate(modes=8)) * importance[:, None]
    for vertex in np.asarray(whole.vertex).reshape(CLUSTERS, -1):
        matrix = np.moveaxis(exact[vertex] * importance[:, None], 1, 0).reshape(ALL, -1)
        close(np.moveaxis(found[vertex], 1, 0).reshape(ALL, -1), best(matrix, 8), tolerance=HALF)


def test_the_first_coefficients_and_terms_are_the_rows_and_columns_themselves(whole, close):
    everything, part = dense(whole), whole.truncate(50, terms=2)
    expected = np.zeros((*everything.shape[:2], 2))
    for number, index in enumerate(np.asarray(whole.index)[:, :50]):
        row = slice(number * 10, (number + 1) * 10)
        expected[row, index] = everything[row][:, index, :2]
    close(dense(part), expected, tolerance=1e-12)
    assert (part.terms, part.index.shape) == (2, (CLUSTERS, 50))
    assert part.nbytes == CLUSTERS * (2 * 50 + 2 * 50 * 30 + 2 * 30 * 10 * 2 + 4 * 10 * 10)
    same(whole.truncate(), whole)


def test_coefficients_are_chosen_by_energy_under_natural_light(whole, small, exact, importance):
    for index, part, vertex in zip(
        np.asarray(whole.index), np.asarray(small.index), np.asarray(whole.vertex).reshape(CLUSTERS, -1), strict=True
    ):
        np.testing.assert_array_equal(np.sort(index), np.arange(ALL))
        np.testing.assert_array_equal(part, index[:100])
        energy = np.sqrt(np.sum(exact[vertex] ** 2, (0, 2))) * importance
        assert np.all(np.diff(energy[index]) <= 1e-5 * energy.max())


def test_remainders_are_those_of_numpys_singular_values(seen, brdf, whole, exact, importance):
    vertex = np.asarray(whole.vertex)[:10]
    options = {name: value for name, value in SMALL.items() if name != "clusters"}
    index, mode, core, weight, after_components, after_modes = separable.clustered.compress(
        jnp.asarray(seen.seen(vertex)), seen.frame[vertex], brdf, **options
    )
    kept = (exact[vertex] * importance[:, None])[:, np.asarray(index)]
    u, value, _ = np.linalg.svd(kept.reshape(10, -1), full_matrices=False)
    total = np.sum(value**2)
    np.testing.assert_allclose(after_components, 1 - np.cumsum([0, *value**2]) / total, atol=1e-5)
    basis = np.einsum("mn,mkr->knr", u[:, :4], kept).reshape(100, -1)
    strength = np.linalg.svd(basis, compute_uv=False)[:8] ** 2
    np.testing.assert_allclose(after_modes, 1 - np.cumsum([0, *strength]) / total, atol=1e-5)
    found = np.einsum("kl,lnr,mn->mkr", *(np.asarray(each, np.float64) for each in (mode, core, weight)))
    error = np.sum((found * importance[np.asarray(index), None] - kept) ** 2) / total
    np.testing.assert_allclose(error, after_modes[-1], rtol=1e-3)


def test_rms_is_that_of_the_dense_rows(whole, small, close):
    for transport in (whole, small, whole.truncate(50, terms=2)):
        close(transport.rms, np.sqrt(np.mean(dense(transport) ** 2, (0, 2))), tolerance=1e-5)


def test_apply_is_the_dense_product(small, random, close):
    lights = random.normal(size=(2, ALL, 3)).astype(np.float32)
    expected = [np.einsum("vdr,dc->vrc", by_vertex(small), light.astype(float)) for light in lights]
    close(small.apply(jnp.asarray(lights[0])), expected[0])
    close(jax.vmap(small.apply)(jnp.asarray(lights)), np.stack(expected))


def test_rows_are_vertices_by_cluster_and_everything_that_is_given_is_in_the_order_of_the_mesh(whole, seen):
    assert sorted(set(np.asarray(whole.vertex).tolist())) == list(range(VERTICES))
    np.testing.assert_array_equal(whole.vertex[whole.place], np.arange(VERTICES))
    assert not np.array_equal(whole.vertex[:VERTICES], np.arange(VERTICES))
    same((whole.position, whole.frame), (seen.position, seen.frame))
    assert isinstance(whole, separable.system.Transport)


def test_clusters_join_what_lies_and_faces_alike(random):
    """Four groups: two places, two sides."""
    group = random.permutation(np.repeat(np.arange(4), 10))
    position = np.array([[0, 0, 0], [5, 0, 0]])[group // 2] + 0.1 * random.normal(size=(40, 3))
    normal = np.array([[0, 0, 1], [0, 0, -1]])[group % 2] + 0.01 * random.normal(size=(40, 3))
    for scale in (1e-6, 1e6):
        member = cluster(jnp.asarray(position * scale + scale), jnp.asarray(normal), clusters=4)
        assert sorted(np.unique(group[member], axis=1).ravel().tolist()) == [0, 1, 2, 3]


def test_workers_of_any_kind_give_the_same_bits_and_a_store_is_resumed(seen, brdf, small, tmp_path):
    path = tmp_path / "a.prt"
    for lost, count in (((), CLUSTERS), ((), 0), ((1, 3), 2)):
        for block in lost:
            np.load(path / "checksum.npy", mmap_mode="r+")[block] = 0
        executor = Strangers()
        same(precompute(seen, brdf, run=prt.Run(path, executor), **SMALL), small)
        assert executor.count == count


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clusters": 0}, "clusters must be between 1 and the 39 points, got 0"),
        ({"clusters": 40}, "clusters must be between 1 and the 39 points, got 40"),
        ({"components": 0}, "components must be between 1 and the 10 vertices of a cluster, got 0"),
        ({"components": 11}, "components must be between 1 and the 10 vertices of a cluster, got 11"),
        ({"keep": 0}, "keep must be between 1 and 384, got 0"),
        ({"keep": 385}, "keep must be between 1 and 384, got 385"),
        ({"modes": 0}, "smaller of keep and components x terms, 30, got 0"),
        ({"modes": 31}, "smaller of keep and components x terms, 30, got 31"),
        ({"keep": 7}, "smaller of keep and components x terms, 7, got 30"),
        (
            {"member": np.arange(38)[None]},
            "member must hold the indices of all 39 vertices and no others, got 1 missing",
        ),
        ({"member": np.arange(40)[None]}, "and indices from 0 to 39"),
        ({"member": np.arange(-1, 39)[None]}, "and indices from -1 to 38"),
    ],
)
def test_impossible_numbers_are_refused(seen, brdf, options, message):
    with pytest.raises(ValueError, match=message):
        precompute(seen, brdf, **WHOLE | options)


@pytest.mark.parametrize(("name", "limit"), [("count", 100), ("modes", 8), ("components", 4), ("terms", 3)], ids=str)
def test_keeping_more_than_there_are_is_refused(small, name, limit):
    for value in (0, -1, limit + 1):
        with pytest.raises(ValueError, match=f"{name} must be between 1 and {limit}, got {value}"):
            small.truncate(**{name: value})


@pytest.mark.usefixtures("unchecked")
def test_brdfs_without_shared_light_maps_are_refused(seen):
    with pytest.raises(TypeError, match=r"must be factored, by jaxprt.separable.factor, got Lambert"):
        precompute(seen, Lambert(0.5), **SMALL)
    colored = SeparableBrdf(jnp.ones((3, 4, 4, 3)), jnp.ones((3, 4, 4, 3)), jnp.zeros(()))
    with pytest.raises(ValueError, match="light maps must have one channel that all colors share, got 3 channels"):
        precompute(seen, colored, **SMALL)


def test_other_brdfs_and_lights_than_it_was_made_for_are_refused(small, brdf):
    light = builtin.daylight(size=SIZE)
    fewer, other = small.truncate(terms=2), factor(Lambert(0.5), terms=TERMS, resolution=12)
    for transport, wrong in ((small, other), (fewer, other.truncate(2))):
        with pytest.raises(ValueError, match="must be the one that the transport was made for, got another"):
            relight(transport, wrong, light)
    separable.SeparableSystem(fewer, brdf.truncate(2))
    with pytest.raises(ValueError, match="the BRDF must have the transport's 3 terms, got 2"):
        relight(small, SeparableBrdf(brdf.light_map[:2], brdf.view_map[:2], brdf.error), light)
    with pytest.raises(ValueError, match=r"the light must be one environment \[6, 8, 8, c\], got \[6, 4, 4, 3\]"):
        relight(small, brdf, builtin.daylight(size=4))
    with pytest.raises(ValueError, match="the light's coefficients must be 384, got 96"):
        small.apply(jnp.ones((96, 3)))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", [(7, 2, 3), (1, 3, 3), (7, 3, 2)])
def test_tuples_of_other_terms_vertices_or_colors_are_not_combined(shape):
    """Terms that one side lacks were left out, without a word."""
    for light, view in (((7, 3, 3), shape), (shape, (7, 3, 3))):
        with pytest.raises(ValueError, match="light and view must have the same vertices, terms and colors, got"):
            separable.system.combine(*(jnp.asarray(np.ones(each, np.float32)) for each in (light, view)))


def test_stores_open_with_visibility_and_factors_that_differ_by_rounding_and_refuse_others(
    seen, brdf, tmp_path, monkeypatch
):
    path, options = tmp_path / "a.prt", SMALL
    first = precompute(seen, brdf, run=prt.Run(path), **options)
    monkeypatch.setattr(separable.clustered, "compress", None)  # Nothing is computed again.
    rounded = eqx.tree_at(lambda x: x.frame, seen, jnp.nextafter(seen.frame, jnp.inf))
    factors = eqx.tree_at(lambda x: x.light_map, brdf, jnp.nextafter(brdf.light_map, jnp.inf))
    again = precompute(rounded, factors, run=prt.Run(path), **options)
    np.testing.assert_array_equal(again.core, first.core)
    darker = eqx.tree_at(lambda x: x.light_map, brdf, 0.99 * brdf.light_map)
    turned = eqx.tree_at(lambda x: x.light_map, brdf, brdf.light_map.at[-1].multiply(-1))
    dimmed = eqx.tree_at(lambda x: x.level, seen, seen.level & 7)
    moved = eqx.tree_at(lambda x: x.position, seen, seen.position.at[7, 1].add(1e-3))
    for what, name in (
        ((seen, darker), "brdf"),
        ((seen, turned), "brdf"),
        ((dimmed, brdf), "direct"),
        ((moved, brdf), "(member|position)"),
        ((seen, brdf, {"keep": 99}), "shapes"),
        ((seen, brdf, {"components": 3}), "shapes"),
    ):
        with pytest.raises(
            ValueError, match=rf"a\.prt holds arrays that were computed from other inputs \({name}: stored"
        ):
            precompute(*what[:2], run=prt.Run(path), **options | dict(*what[2:]))


def test_clusters_grow_with_the_root_of_the_vertices_and_sizes_fit_any_mesh(brdf):
    assert [members.clusters_for(count) for count in (1, 3, 100, 36_000, 1_000_000)] == [1, 1, 8, 159, 840]
    triangle = visibility.precompute(builtin.plane(cells=1), size=2)
    few = precompute(triangle, brdf)
    assert (few.core.shape[2], few.index.shape) == (2, (2, 24))
    light = builtin.daylight(size=2)
    exact = project(jnp.asarray(triangle.seen(np.arange(4))), triangle.frame, brdf)[..., 0]
    expected = np.einsum("vdr,dc->vrc", exact, separable.system.project(light))
    np.testing.assert_allclose(few.apply(separable.system.project(light)), expected, atol=3e-3 * np.abs(expected).max())


def test_jobs_send_mapped_visibility_by_the_name_of_its_file(brdf, tmp_path):
    mesh = builtin.sphere(rings=12, sectors=14)
    mapped = visibility.precompute(mesh, size=8, run=prt.Run(tmp_path / "a.prt"))
    held, jobs = visibility.precompute(mesh, size=8), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(visibility.blocks, "compute", lambda job, *_, **__: jobs.append(job) or {}["stop"])
        for seen in (mapped, held):
            with pytest.raises(KeyError):
                precompute(seen, brdf, keep=9)
    sent = [pickle.dumps(job) for job in jobs]
    assert len(sent[0]) < len(sent[1]) - mapped.nbytes + 1000
    for there in map(pickle.loads, sent):
        for name, value in jobs[1].run(1)[0].items():
            np.testing.assert_array_equal(there.run(1)[0][name], value)
