import pathlib
import subprocess

import numpy as np
import pytest

from jaxprt.sphere import patches

SUBDIVISIONS = [1, 2, 3, 4, 5, 6]


def rcalc(rows, *expressions):
    """Radiance's calculator, applied to rows of numbers."""
    folder = pathlib.Path(pytest.importorskip("pyradiance").__file__).parent
    cal = [argument.replace("LIB", str(folder / "lib")) for argument in expressions]
    text = "\n".join(" ".join(map(repr, row)) for row in np.asarray(rows).tolist())
    done = subprocess.run([folder / "bin" / "rcalc", *cal], input=text, capture_output=True, text=True, check=True)
    return np.array([line.split() for line in done.stdout.splitlines()], float)


def test_counts_are_the_published_ones():
    assert [patches.count(subdivision) for subdivision in SUBDIVISIONS] == [146, 578, 1298, 2306, 3602, 5186]


def test_rows_of_tregenza_have_the_published_counts_and_altitudes():
    altitude = np.degrees(np.arcsin(patches.centers()[1:, 1]))
    value, size = np.unique(altitude.round(6), return_counts=True)
    np.testing.assert_allclose(value, [6, 18, 30, 42, 54, 66, 78, 90])
    assert size.tolist() == [30, 30, 24, 24, 18, 12, 6, 1]


def test_rows_start_at_north_and_turn_to_the_east():
    center = patches.centers()
    assert center[0].tolist() == [0, -1, 0]
    np.testing.assert_allclose(center[1], [0, np.sin(np.pi / 30), -np.cos(np.pi / 30)], atol=1e-15)
    assert center[2, 0] > 0
    assert center[-1].tolist() == [0, 1, 0]


@pytest.mark.parametrize("subdivision", SUBDIVISIONS)
def test_solid_angles_sum_to_the_sphere_and_projected_ones_to_the_disk(subdivision):
    solid = patches.solid_angles(subdivision=subdivision)
    assert [solid[0], solid[1:].sum()] == pytest.approx([2 * np.pi, 2 * np.pi], rel=1e-12)
    projected = patches.projected_solid_angles(subdivision=subdivision)
    assert [projected[0], projected[1:].sum()] == pytest.approx([np.pi, np.pi], rel=1e-12)


def test_solid_angles_equal_counts_of_random_directions():
    direction = np.random.default_rng(0).normal(size=(1_000_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    index = patches.index_of(direction)
    share = 4 * np.pi / len(direction)
    noise = np.sqrt(patches.solid_angles() * share)
    assert (abs(np.bincount(index, minlength=146) * share - patches.solid_angles()) < 5 * noise).all()
    projected = np.bincount(index, abs(direction[:, 1]), minlength=146) * share
    assert (abs(projected - patches.projected_solid_angles()) < 5 * noise).all()


@pytest.mark.parametrize("subdivision", SUBDIVISIONS)
def test_index_of_the_center_is_the_patch(subdivision):
    center = patches.centers(subdivision=subdivision)
    np.testing.assert_array_equal(
        patches.index_of(3 * center, subdivision=subdivision), np.arange(patches.count(subdivision))
    )


@pytest.mark.parametrize("subdivision", [1, 4])
def test_patches_are_those_of_radiance(subdivision):
    factor = f"MF:{subdivision}"
    row = np.arange(1, patches.count(subdivision))[:, None]
    east, north, up = rcalc(row, "-e", factor, "-f", "LIB/reinsrc.cal", "-e", "Rbin=$1;$1=Dx;$2=Dy;$3=Dz;$4=Romega").T[
        :3
    ]
    center = patches.centers(subdivision=subdivision)[1:]
    # reinsrc.cal puts its direction for the zenith half a row above 90 degrees.
    np.testing.assert_allclose(center[:-1], np.stack([east, up, -north], axis=-1)[:-1], atol=1e-6)
    direction = np.random.default_rng(1).normal(size=(3, 2000))
    x, y, z = direction / np.linalg.norm(direction, axis=0)
    index = rcalc(
        np.stack([x, -z, y], axis=-1), "-e", factor, "-f", "LIB/reinhart.cal", "-e", "Dx=$1;Dy=$2;Dz=$3;$1=rbin"
    )[:, 0]
    np.testing.assert_array_equal(patches.index_of(direction.T, subdivision=subdivision), index)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="between 1 and 6, got 7"):
        patches.count(7)
    with pytest.raises(ValueError, match="must not be zero, got 1 that are, first at 1"):
        patches.index_of(np.array([[0.0, 1, 0], [0, 0, 0]]))
