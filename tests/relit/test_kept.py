"""What is fitted is kept: taken again for the same, made again for all else."""

import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import GGX
from jaxprt.relit import recipes
from jaxprt.relit.kept import kept
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin


def light(value=1.0):
    return Environment(np.full((6, 2, 2, 3), value, np.float32))


@pytest.mark.parametrize("other", [(GGX(roughness=0.5), 4), (GGX(roughness=0.4), 5), ("plain", 4)])
def test_another_key_makes_anew(tmp_path, other):
    made = []

    def make():
        made.append(light(len(made)))
        return made[-1]

    path = tmp_path / "kept"
    key = GGX(roughness=0.4), 4
    first, again = kept(path, key, make), kept(path, key, make)
    np.testing.assert_array_equal(first.radiance, again.radiance)
    assert len(made) == 1
    kept(path, other, make)
    assert len(made) == 2
    np.testing.assert_array_equal(kept(path, other, make).radiance, made[1].radiance)


def test_what_is_damaged_or_has_no_name_is_made_anew(tmp_path):
    path = tmp_path / "kept"
    kept(path, 1, light)
    file = next(path.glob("*.npy"))
    file.write_bytes(file.read_bytes()[:-4] + b"\1\2\3\4")
    np.testing.assert_array_equal(kept(path, 1, light).radiance, light().radiance)
    other = tmp_path / "function"
    kept(other, lambda: None, light)
    assert not other.exists()


def test_a_stored_scene_fits_no_lobes_again(tmp_path, coarse, bound, monkeypatch):
    bound(monkeypatch, prt.lobe.tabulate, resolution=4)
    material = TexturedMaterial(base_color=0.5, metallic=0.0, roughness=0.6)
    scene = Scene([Part("ball", builtin.sphere(rings=3, sectors=4), material)])
    options = {"system": prt.relit.Lobes(1, texels=0), "size": 8, "path": tmp_path / "store", "progress": False}
    first = prt.precompute(scene, **options)

    def tabulate(*argument, **option):
        raise AssertionError("the table is kept")

    monkeypatch.setattr(recipes.lobe, "tabulate", tabulate)
    again = prt.precompute(scene, **options)
    np.testing.assert_array_equal(first.direct.part[0].brdf.scale, again.direct.part[0].brdf.scale)
