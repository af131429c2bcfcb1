"""Checks of values where they enter."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import require


def test_the_message_counts_and_names_the_first_value_that_is_not_finite():
    with pytest.raises(
        ValueError, match=r"the eye must be finite, got 2 of 6 values that are not, first at \(0, 2\): inf"
    ):
        require.finite("the eye", np.array([[0, 1, np.inf], [np.nan, 2, 3]]))
    with pytest.raises(ValueError, match="the weight must be finite, got 1 of 1 values that are not: nan"):
        require.finite("the weight", float("nan"))


def test_values_below_a_bound_are_refused_by_name():
    require.at_least("the albedo", [0, 0.5], 0.0)
    require.at_least("the share", -1e-7, 0.0, slack=1e-6)
    with pytest.raises(
        ValueError, match=r"the albedo must be at least 0, got 1 of 2 values that are not, first at \(1,\): -1"
    ):
        require.at_least("the albedo", jnp.array([0, -1]), 0.0)
    with pytest.raises(ValueError, match="the albedo must be finite, got 1 of 1 values that are not: nan"):
        require.at_least("the albedo", np.nan, 0.0)


@pytest.mark.parametrize("shape", [(), (4,), (3, 1)])
def test_a_position_has_three_values_also_where_they_are_traced(shape):
    require.position("the eye", [1, 2, 3])
    with pytest.raises(
        ValueError, match=rf"the eye must be one position, \[3\], got an array of shape {re.escape(str(list(shape)))}"
    ):
        jax.eval_shape(lambda x: require.position("the eye", x), jnp.ones(shape))


def test_traced_values_pass_and_stay_as_they_are():
    def through(x):
        require.finite("x", x)
        require.at_least("x", x, 0.0)
        return 2 * x

    assert jnp.isnan(jax.jit(through)(jnp.asarray(jnp.nan)))


def test_counts_outside_a_range_are_refused():
    for value in (1, 4):
        require.count("terms", value, least=1, most=4)
    for value in (-1, 0, 5):
        with pytest.raises(ValueError, match=f"terms must be between 1 and 4, got {value}"):
            require.count("terms", value, least=1, most=4)


def test_objects_of_another_class_are_refused_by_the_class_required_and_the_function_that_makes_it():
    require.kind("the light", 1.0, int, float, source="make")
    with pytest.raises(
        TypeError, match="the light must be of class int or str, which make makes, got one of class list"
    ):
        require.kind("the light", [], int, str, source="make")
    with pytest.raises(TypeError, match=r"class int, which make makes, got an array of shape \[2, 3\]"):
        require.kind("the light", jnp.zeros((2, 3)), int, source="make")


def test_arrays_must_have_one_of_the_ways_of_axes():
    require.array("the eye", np.zeros((5, 3)), "3", "v 3")
    with pytest.raises(ValueError, match=r"the eye must be an array \[3\] or \[v, 3\], got an array of shape \[4, 2\]"):
        require.array("the eye", np.zeros((4, 2)), "3", "v 3")
    with pytest.raises(TypeError, match=r"an array \[3\], which look makes, got one of class tuple"):
        require.array("the eye", (1, 2, 3), "3", source="look")


def test_checked_arguments_are_known_before_the_function_is_compiled():
    @require.arguments(x=lambda x: require.finite("x", x))
    @jax.jit
    def double(x, *, y=0):
        return 2 * x + y

    assert double(jnp.ones(()), y=1) == 3
    with pytest.raises(ValueError, match="x must be finite"):
        double(x=jnp.asarray(jnp.nan))
    assert jnp.isnan(jax.jit(double)(jnp.asarray(jnp.nan)))


def test_whole_numbers_outside_a_range_are_counted():
    require.within("the texels", np.array([0, 383]), 0, 383)
    with pytest.raises(ValueError, match=r"the texels must be between 0 and 383, got 2 of 3 .* first at \(0,\): -1"):
        require.within("the texels", np.array([-1, 5, 384]), 0, 383)


def test_lists_that_hold_traced_values_are_positions():
    place = jax.jit(lambda x: require.position("the eye", [x, 1.0, 2.0]))(0.5)
    np.testing.assert_array_equal(place, [0.5, 1.0, 2.0])
    with pytest.raises(TypeError, match="error must be real numbers, got an integer of more than 64 bits"):
        require.number("error", 2**70, 0.0)


def test_lists_that_hold_themselves_are_no_numbers_and_leave_the_stack_as_it_was():
    """JAX would recurse in them until no function can be called any more."""
    loop, deep = [1.0], [1.0]
    loop.append(loop)
    for _ in range(5000):
        deep = [deep]
    for value in (loop, deep):
        with pytest.raises(TypeError, match="the eye must be real numbers, got one of class list"):
            require.position("the eye", value)
    assert require.shown(deep) == "lists or objects that are nested too ... of class list"


@pytest.mark.parametrize(
    "wrong", [np.eye(2), 2 * np.eye(3), np.diag([1, 1, -1]), np.full((3, 3), np.nan), 5, np.eye(4)]
)
def test_only_proper_rotations_are_rotations(wrong):
    turn = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    np.testing.assert_array_equal(require.rotation("rotation", turn), turn)
    with pytest.raises(ValueError, match="rotation must be a 3 x 3 rotation matrix, got"):
        require.rotation("rotation", wrong)


def test_what_has_no_numbers_is_described():
    with pytest.raises(TypeError, match="light must be real numbers, got values of type key<fry>"):
        require.real("light", jax.random.key(0))

    class Strange:
        def __fspath__(self):
            return b"x"

    with pytest.raises(ValueError, match="path must be a path, got"):
        require.path("path", Strange())
