from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import compile as compiled
from jaxprt.compile import isolated, jit, linear, mapped, total


def product(fixed, x):
    return fixed["matrix"] @ x


def transposed(fixed, y):
    return fixed["transpose"] @ y


@pytest.fixture
def matrix(x64):
    return jnp.asarray(np.random.default_rng(0).normal(size=(3, 4)))


@pytest.fixture
def x(x64):
    return jnp.asarray(np.random.default_rng(1).normal(size=(4, 2)))


def ours(x, matrix):
    return jnp.sum(jnp.sin(linear(product, transposed, {"matrix": matrix, "transpose": matrix.T}, x)))


def theirs(x, matrix):
    return jnp.sum(jnp.sin(matrix @ x))


def twice(function):
    return jax.jacfwd(jax.grad(function))


@pytest.mark.parametrize(
    "change",
    [
        twice,
        lambda f: jax.jacrev(jax.grad(f)),
        lambda f: twice(lambda x, matrix: jnp.sum(jax.grad(f)(x, matrix) ** 2)),
        lambda f: jax.jacobian(jax.grad(f), 1),
        lambda f: jax.jacobian(jax.grad(f, 1), 0),
        lambda f: lambda x, matrix: jax.linearize(partial(f, matrix=matrix), x)[1](x),
    ],
)
def test_a_map_and_its_transpose_have_the_derivatives_of_the_map(change, x, matrix):
    found, expected = (jax.jit(change(function))(x, matrix) for function in (ours, theirs))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def second(x, matrix):
    """The Hessian of `theirs` by x."""
    return -np.einsum("mi,mj,mk,jl->ijkl", matrix, np.sin(matrix @ x), matrix, np.eye(2))


# Derivatives of `theirs`, in NumPy: nothing to compile.
CHANGES = [
    (lambda f: f, lambda x, matrix: np.sum(np.sin(matrix @ x))),
    (jax.grad, lambda x, matrix: matrix.T @ np.cos(matrix @ x)),
    (lambda f: jax.grad(f, 1), lambda x, matrix: np.cos(matrix @ x) @ x.T),
    (twice, second),
]


@pytest.mark.parametrize("axes", [(None, None), (0, None), (None, 0), (2, 1)])
@pytest.mark.parametrize(("change", "one"), CHANGES)
def test_values_and_derivatives_are_those_of_numpy_and_batches_are_loops(axes, change, one, x, matrix):
    if axes == (None, None):  # outside of any program
        function = jax.jit(twice(ours)) if change is twice else change(ours)
        np.testing.assert_allclose(function(x, matrix), one(x, matrix), rtol=1e-12, atol=1e-13)
        return
    random = np.random.default_rng(2)
    batch = [
        np.asarray(each) if axis is None else random.normal(size=(*each.shape[:axis], 5, *each.shape[axis:]))
        for each, axis in zip((x, matrix), axes, strict=True)
    ]
    expected = [
        one(*(b if a is None else np.take(b, n, a) for b, a in zip(batch, axes, strict=True))) for n in range(5)
    ]
    found = jax.jit(jax.vmap(change(ours), axes))(*batch)
    np.testing.assert_allclose(found, np.stack(expected), rtol=1e-12, atol=1e-13)


def test_a_batch_of_values_has_a_gradient(x, matrix):
    x, matrix = np.asarray(x), np.asarray(matrix)
    batch = np.stack([x, 2 * x, -x])
    values = np.sum(np.sin(matrix @ batch), (1, 2))
    expected = 2 * values[:, None, None] * (matrix.T @ np.cos(matrix @ batch))
    found = jax.jit(jax.grad(lambda batch: jnp.sum(jax.vmap(ours, (0, None))(batch, matrix) ** 2)))(batch)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_given_transpose_is_what_makes_the_gradient(x, matrix):
    fixed = {"matrix": matrix, "transpose": 7 * matrix.T}
    slope = jax.jit(jax.grad(lambda x: jnp.sum(linear(product, transposed, fixed, x))))(x)
    np.testing.assert_allclose(slope, 7 * np.asarray(matrix).T @ np.ones((3, 2)), rtol=1e-12)


def test_the_gradient_has_the_type_of_its_argument(matrix):
    assert jax.eval_shape(jax.grad(ours), jnp.ones((4, 2), jnp.float32), matrix).dtype == jnp.float32


@partial(isolated, static=("power",))
def step(x, y, *, power):
    return x**power * y["y"], x - y["y"]


def plain(x, y, *, power):
    return x**power * y["y"], x - y["y"]


def called(function, x):
    first, second = function(x, y={"y": jnp.cos(x)}, power=3)
    return jnp.sum(first * second)


@pytest.mark.parametrize("change", [lambda f: f, lambda f: jax.jit(jax.grad(f)), lambda f: jax.jit(jax.hessian(f))])
def test_a_step_apart_is_the_step(change, x64):
    found, expected = change(partial(called, step)), jax.jit(change(partial(called, plain)))
    for value in (1.5, 0.0, -1.0, 1e-30, 1e30):
        x = np.full((3, 2), value)
        np.testing.assert_allclose(found(x), expected(x), rtol=1e-12)


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf, -jnp.inf])
def test_a_step_apart_is_taken_whatever_comes_first(value):
    doubled = jax.jit(isolated(lambda x: 2 * jnp.where(jnp.isfinite(x), x, 1)))
    np.testing.assert_array_equal(doubled(np.float32([value, 3.0])), [2, 6])


def test_steps_take_whole_numbers_and_nothing():
    assert jax.jit(isolated(lambda x: x + 1))(jnp.array([-1, 4])).tolist() == [0, 5]
    assert jax.jit(isolated(lambda x: x + 1))(jnp.zeros((0, 3))).shape == (0, 3)


def test_on_cpus_a_step_inside_a_program_is_a_branch_of_its_own():
    text = jax.jit(isolated(lambda x: jnp.sin(x) + 1)).lower(jnp.ones(3)).as_text()
    assert ("case" in text) == (jax.default_backend() == "cpu")


def test_a_gradient_outside_any_program_is_compiled_once():
    traces = []

    def counted(x):
        traces.append(x)
        return jnp.sin(x) ** 2

    step = isolated(counted)
    slope = jax.grad(lambda x: jnp.sum(step(x)))
    first = slope(jnp.ones(3))
    before = len(traces)
    np.testing.assert_array_equal(slope(jnp.ones(3)), first)
    assert len(traces) == before


def summed(index, value, table):
    return total(lambda row: table[row[0]] * row[1][:, None], (index, value))


def each(index, value, table):
    return mapped(lambda row: (table[row[0]] * row[1][:, None]).T, (index, value))


@pytest.fixture
def rows(x64):
    random = np.random.default_rng(3)
    index, value, table = random.integers(6, size=(7, 5)), random.normal(size=(7, 5)), random.normal(size=(6, 3))
    return jnp.asarray(index), jnp.asarray(value), jnp.asarray(table)


@pytest.mark.parametrize("room", [1 << 28, 250, 1])
@pytest.mark.parametrize("form", ["cpu", "default"])
def test_loops_give_the_same_in_the_form_of_every_device(form, room, rows, monkeypatch):
    monkeypatch.setattr(compiled, "_ROOM", room)  # All rows at once, some, or one.
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *arguments, **forms: forms[form](*arguments))
    index, value, table = map(np.asarray, rows)
    one = table[index] * value[..., None]
    weight = np.random.default_rng(4).normal(size=one.shape)
    expected = {summed: (one.sum(0), weight[0], weight[:1]), each: (one.swapaxes(1, 2), weight.swapaxes(1, 2), weight)}
    for loop, (result, seen, of_rows) in expected.items():

        @jax.jit
        def everything(index, value, table, loop=loop, seen=seen):
            slope = jax.grad(lambda t, v: jnp.sum(loop(index, v, t) * seen), (0, 1))
            batch = jax.vmap(loop, (None, None, 0))(index, value, jnp.stack([table, 2 * table]))
            return loop(index, value, table), slope(table, value), batch

        found, (by_table, by_value), batch = everything(index, value, table)
        np.testing.assert_allclose(found, result, rtol=1e-12)
        np.testing.assert_allclose(batch[1], 2 * result, rtol=1e-12)
        np.testing.assert_allclose(by_value, np.sum(table[index] * of_rows, -1), rtol=1e-11)
        slope = np.zeros(table.shape)
        np.add.at(slope, index, value[..., None] * of_rows)
        np.testing.assert_allclose(by_table, slope, rtol=1e-11)
    nothing = np.asarray(jax.jit(summed)(index[:0], value[:0], table))
    np.testing.assert_array_equal(nothing, np.zeros((5, 3)))


def test_programs_for_gpus_have_no_loops_over_rows_no_branches_to_choose_and_exact_products(rows, loose):
    step = isolated(lambda x: jnp.sin(x) @ x.T)

    def both(index, value, table):
        return step(summed(index, value, table))

    program = jit(both).trace(*rows)
    cpu, gpu = (program.lower(lowering_platforms=(name,)).as_text() for name in ("cpu", "cuda"))
    assert "while" in cpu
    assert "while" not in gpu
    assert "precision = [HIGHEST, HIGHEST]" in gpu
    assert not loose(both, *rows)
    assert loose(lambda x: x @ x, jnp.ones((2, 2)))


def test_products_inside_maps_and_their_transposes_are_exact(matrix, x, loose):
    assert not loose(jax.grad(ours), x, matrix)


def test_in_a_batch_a_step_remains_a_branch_of_its_own():
    step = jax.vmap(isolated(lambda x: jnp.sin(x) + 1))
    text = jax.jit(step).lower(jnp.ones((2, 3))).as_text()
    assert ("case" in text) == (jax.default_backend() == "cpu")
    np.testing.assert_allclose(step(jnp.array([[0.5], [2.0]])), np.sin([[0.5], [2.0]]) + 1, rtol=1e-6)


def test_a_batch_is_mapped_in_turn_with_its_gradient(x, matrix):
    x, matrix = np.asarray(x), np.asarray(matrix)
    batch = np.stack([x, 2 * x, -x])

    def total(batch):
        mapped = jax.vmap(lambda x: linear(product, None, {"matrix": matrix, "transpose": None}, x, in_turn=True))
        return jnp.sum(jnp.sin(mapped(batch)))

    value, slope = jax.jit(jax.value_and_grad(total))(batch)
    np.testing.assert_allclose(value, np.sum(np.sin(matrix @ batch)), rtol=1e-12)
    np.testing.assert_allclose(slope, np.swapaxes(matrix, 0, 1) @ np.cos(matrix @ batch), rtol=1e-12)
