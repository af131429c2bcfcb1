"""Radiance scenes, sensor grids and Honeybee's model folders."""

import json
import os
import pathlib
import subprocess
from collections.abc import Sequence

import numpy as np
import pytest

from jaxprt.daylight.files import load_honeybee, load_rad, load_sensors
from jaxprt.scene import Part, Scene, TexturedMaterial
from jaxprt.scene.sides import two_sided
from jaxprt.visibility import Occluder

AREA = 1e-6  # of triangles in float32
WHITE = "void plastic white 0 0 5 .7 .6 .5 0 0\n"
GLASS = "void glass pane 0 0 3 .6 .7 .8\n"
# A wall of 4 x 3 m in the plane y = 0 with a window of 2 x 1 m. The outline reaches the hole by the edge from 0 0 0.
WALL = [[0, 0, 0], [1, 0, 1], [3, 0, 1], [3, 0, 2], [1, 0, 2], [1, 0, 1], [0, 0, 0], [0, 0, 3], [4, 0, 3], [4, 0, 0]]
WINDOW = [[1, 0, 1], [3, 0, 1], [3, 0, 2], [1, 0, 2]]
L_SHAPE = [[0, 0, 0], [4, 0, 0], [4, 1, 0], [1, 1, 0], [1, 5, 0], [0, 5, 0]]
TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def polygon(corners: Sequence | np.ndarray, *, material: str = "white") -> str:
    numbers = "\n".join(" ".join(f"{value:.17g}" for value in corner) for corner in corners)
    return f"\n{material} polygon surface\n0\n0\n{3 * len(corners)}\n{numbers}\n"


def written(folder: pathlib.Path, content: str, *, name: str = "scene.rad") -> pathlib.Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def room() -> str:
    """A room of 4 x 6 x 3 m whose wall to the south has a window."""
    corners = np.stack(np.meshgrid([0, 4], [0, 6], [0, 3], indexing="ij"), -1).reshape(-1, 3)
    sides = [0, 4, 6, 2], [1, 3, 7, 5], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]
    return WHITE + polygon(WALL) + "".join(polygon(corners[side]) for side in sides)


def triangles(part: Part) -> np.ndarray:
    position = np.asarray(part.mesh.position, np.float64) + np.asarray(part.mesh.origin)
    return position[np.asarray(part.mesh.face)]


def material(scene: Scene, name: str) -> TexturedMaterial:
    value = scene[name].material
    assert isinstance(value, TexturedMaterial)
    return value


def area_vector(part: Part) -> np.ndarray:
    corner = triangles(part)
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2


def area(part: Part) -> float:
    return float(np.linalg.norm(area_vector(part), axis=1).sum())


def test_triangles_of_a_wall_leave_out_its_window(tmp_path):
    scene, _ = load_rad(written(tmp_path, WHITE + polygon(WALL)))
    assert area(scene["white"]) == pytest.approx(4 * 3 - 2 * 1, rel=AREA)
    # From outside, rays through the window pass, and all others hit.
    point = np.random.default_rng(0).uniform(0, 1, (500, 3)) * [4, 3, 0] + [0, 0, 1]
    triangle, *_ = Occluder(scene.mesh).hit(
        point.astype(np.float32), np.tile(np.array([0, 0, -1], np.float32), (500, 1))
    )
    inside = (np.abs(point[:, 0] - 2) < 1) & (np.abs(point[:, 1] - 1.5) < 0.5)
    np.testing.assert_array_equal(triangle < 0, inside)


@pytest.mark.parametrize("turns", range(6))
def test_the_first_corner_of_a_concave_polygon_does_not_matter(tmp_path, turns):
    scene, _ = load_rad(written(tmp_path, WHITE + polygon(L_SHAPE[turns:] + L_SHAPE[:turns])))
    np.testing.assert_allclose(area_vector(scene["white"]).sum(0), [0, 8, 0], rtol=AREA)
    assert area(scene["white"]) == pytest.approx(8, rel=AREA)


@pytest.mark.parametrize("seed", range(5))
def test_a_tilted_polygon_with_many_windows_has_its_area(tmp_path, seed):
    generator = np.random.default_rng(seed)
    rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    outline, holes = [[0, 0, 0]], 0.0
    for column in range(12):  # each window hangs on an edge up from the lower border
        low, high = column + 0.2, column + generator.uniform(0.4, 0.9)
        bottom, top = generator.uniform(0.2, 1), generator.uniform(1.5, 2.8)
        outline += [[low, 0, 0], [low, bottom, 0], [low, top, 0], [high, top, 0], [high, bottom, 0]]
        outline += [[low, bottom, 0], [low, 0, 0]]
        holes += (high - low) * (top - bottom)
    outline += [[12, 0, 0], [12, 3, 0], [0, 3, 0]]
    scene, _ = load_rad(written(tmp_path, WHITE + polygon(np.array(outline) @ rotation.T)))
    assert area(scene["white"]) == pytest.approx(36 - holes, rel=10 * AREA)


def test_north_is_minus_z_and_normals_keep_their_side(tmp_path):
    scene, _ = load_rad(written(tmp_path, WHITE + polygon([[1, 2, 3], [2, 2, 3], [1, 4, 3]])))
    np.testing.assert_array_equal(scene["white"].mesh.position, [[1, 3, -2], [2, 3, -2], [1, 3, -4]])
    np.testing.assert_allclose(scene["white"].mesh.normal, np.tile([0, 1, 0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(area_vector(scene["white"]), [[0, 1, 0]])


def test_surfaces_are_lit_from_both_sides_unless_they_enclose_a_solid(tmp_path):
    scene, _ = load_rad(written(tmp_path, room()))
    assert material(scene, "white").back == "lit"
    assert len(two_sided(scene).mesh.face) == 2 * len(scene.mesh.face)


def test_materials_keep_their_diffuse_reflectance(tmp_path):
    materials = {
        "plastic": ("5 .8 .6 .4 .5 .1", [0.4, 0.3, 0.2]),
        "metal": ("5 .8 .6 .4 .75 .1", [0.2, 0.15, 0.1]),
        "trans": ("7 .8 .6 .4 .5 0 .5 .1", [0.2, 0.15, 0.1]),
        "mirror": ("3 .9 .9 .9", [0, 0, 0]),
    }
    content = "".join(
        f"void {kind} m_{kind} 0 0 {numbers}\n{polygon(TRIANGLE, material=f'm_{kind}')}"
        for kind, (numbers, _) in materials.items()
    )
    message = "left out 1 materials of type metal .*, 1 materials of type trans .*, 1 materials of type mirror"
    with pytest.warns(UserWarning, match=message):
        scene, glass = load_rad(written(tmp_path, content))
    assert glass == {}
    for kind, (_, color) in materials.items():
        np.testing.assert_allclose(material(scene, f"m_{kind}").base_color, color, atol=1e-6)
        assert material(scene, f"m_{kind}").metallic == material(scene, f"m_{kind}").specular == 0


def test_glass_is_a_part_of_its_own_with_its_transmissivity(tmp_path):
    index = GLASS.replace("pane", "coated").replace("3 .6 .7 .8", "4 .5 .5 .5 1.6")
    content = room() + GLASS + index + polygon(WINDOW, material="pane") + polygon(TRIANGLE, material="coated")
    scene, glass = load_rad(written(tmp_path, content))
    assert scene.names == ["white", "pane", "coated"]
    assert glass == {"pane": pytest.approx(0.7), "coated": 0.5}
    assert area(scene["pane"]) == pytest.approx(2, rel=AREA)


def test_later_definitions_and_aliases_hold_for_later_polygons(tmp_path):
    first = written(tmp_path, WHITE + polygon(TRIANGLE), name="first.rad")
    later = WHITE.replace(".7", ".1") + "void alias gray white\n" + polygon(TRIANGLE) + polygon(WINDOW, material="gray")
    scene, _ = load_rad(first, written(tmp_path, later, name="later.rad"))
    assert scene.names == ["white", "white (2)"]
    assert [round(float(material(scene, name).base_color[0]), 3) for name in scene.names] == [0.7, 0.1]
    assert [len(part.mesh.face) for part in scene.parts] == [1, 3]
    same, _ = load_rad(first, first)
    assert same.names == ["white"]
    assert same.counts == [6]


def test_layout_and_comments_do_not_matter(tmp_path):
    scattered = "# 1 polygon # white\r\nvoid\tplastic\n wall#1 # a name\n\n0 0 5 .7\n.7 .7 0 0 "
    scene, _ = load_rad(written(tmp_path, scattered + polygon(TRIANGLE, material="wall#1").replace("\n", " ")))
    assert scene.names == ["wall#1"]


def test_lamps_skies_and_flat_polygons_are_counted(tmp_path):
    sky = (
        "void brightfunc skyfunc 2 skybr sky.cal 0 1 1\nskyfunc glow sky 0 0 4 1 1 1 0\nsky source up 0 0 4 0 0 1 180\n"
    )
    lamp = "void light bulb 0 0 3 9 9 9\nbulb sphere ball 0 0 4 0 0 1 .1\n" + polygon(TRIANGLE, material="bulb")
    flat = polygon([[0, 0, 0], [1, 1, 1], [2, 2, 2]]) + polygon(TRIANGLE, material="void")
    path = written(tmp_path, WHITE + sky + lamp + flat + polygon(TRIANGLE))
    message = "1 surfaces of type source, 2 surfaces of light, 1 surfaces of void, 1 polygons without area"
    with pytest.warns(UserWarning, match=message):
        scene, _ = load_rad(path)
    assert scene.counts == [3]


def test_polygons_may_touch_themselves_at_a_corner(tmp_path):
    touching = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0], [1, 2, 0], [1, 1, 0], [0, 1, 0]]
    scene, _ = load_rad(written(tmp_path, WHITE + polygon(touching)))
    assert area(scene["white"]) == pytest.approx(2, rel=AREA)


def test_polygons_that_cross_themselves_are_named(tmp_path):
    crossed = polygon([[0, 0, 0], [2, 0, 0], [0.5, 1, 0], [2, 3, 0]])
    with pytest.warns(UserWarning, match=r"scene.rad, line 3: 1 polygons of 'white' cross themselves"):
        load_rad(written(tmp_path, WHITE + crossed))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("!xform -t 0 0 1 desk.rad\n", r"line 2: the scene must have no commands, got '!xform .*xform -e"),
        ("white sphere ball 0 0 4 0 0 0 1\n", r"line 2: shapes must be polygons, got a sphere, 'ball'"),
        ("white plygon p 0 0 3 0 0 0\n", r"line 2: expected a modifier, a type .* got 'plygon'"),
        ("white polygon\n", r"line 2: the primitive must have a modifier, a type and an identifier"),
        ("white polygon p 0 0 9 0 0 0", r"line 2: the primitive must have 9 numbers, and the file ends"),
        ("white polygon p 0 0\nx", r"line 3: 'p' must have a count of numbers, got 'x'"),
        ("white polygon p 0 0 9\n0 0 0 1 0 0 0\n1 zero", r"line 4: expected a finite number, got 'zero'"),
        ("white polygon p 0 0 9 0 0 0 1 0 0 0 1 nan", r"line 2: expected a finite number, got 'nan'"),
        ("white polygon p 0 0 8 0 0 0 1 0 0 0 1", r"line 2: a polygon must have three numbers .* got 8"),
        ("white polygon p 0 0 6 0 0 0 1 0 0", r"line 2: a polygon must have three numbers .* got 6"),
        ("gray polygon p 0 0 9 0 0 0 1 0 0 0 1 0", r"line 2: material 'gray' must be defined before its use"),
        ("void alias gray black\n", r"line 2: material 'black' must be defined before its use"),
        ("void plastic p 0 0 4 1 1 1 0\n", r"line 2: plastic must have 5 numbers, got 4"),
        ("void plastic p 0 0 5 1.1 1 1 0 0\n", r"line 2: plastic must have shares of light from 0 to 1, got"),
        ("void glass p 0 0 3 1 1 -1\n", r"line 2: glass must have shares of light from 0 to 1.0886"),
        ("void trans p 0 0 7 1 1 1 0 0 2 0\n", r"line 2: trans must have shares of light from 0 to 1"),
        (
            "void BSDF blind 6 0 b.xml 0 0 1 . 0 0\n" + polygon(TRIANGLE, material="blind"),
            r"line 4: polygons must have unmodified .* got BSDF with modifier 'void', 'blind' of .*line 2",
        ),
        (
            "void colorpict wood 0 0 0\nwood plastic desk 0 0 5 1 1 1 0 0\n" + polygon(TRIANGLE, material="desk"),
            r"line 5: polygons must have .* got plastic with modifier 'wood', 'desk'",
        ),
        (
            polygon([*WALL[:2], *WALL[4:1:-1], *WALL[5:]]),
            r"line 3: a hole must run opposite to the outline, got one along it",
        ),
        ("", "must hold polygons of materials, got none"),
        ("void plastic \0", "must be a Radiance scene, got one that is not text"),
    ],
)
def test_wrong_scenes_are_refused_by_line(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"scene\.rad.*{message}"):
        load_rad(written(tmp_path, WHITE + content))


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.rad must be a Radiance scene"):
        load_rad(tmp_path / "none.rad")
    with pytest.raises(ValueError, match="one or more files"):
        load_rad()


def test_sensors_have_our_axes_and_unit_normals(tmp_path):
    path = written(tmp_path, "# x y z\n1 2 3 0 0 2\n\n1.5,2,3, 0,1e-300,0 # north\n", name="grid.pts")
    position, normal = load_sensors(path)
    np.testing.assert_array_equal(position, [[1, 3, -2], [1.5, 3, -2]])
    np.testing.assert_array_equal(normal, [[0, 1, 0], [0, 0, -1]])
    assert position.dtype == normal.dtype == np.float64


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3 0 0 1\n1 2 3\n", r"line 2: a sensor must have six numbers, x y z nx ny nz, got 3"),
        ("1 2 3 0 0 1 7\n", r"line 1: a sensor must have six numbers, x y z nx ny nz, got 7"),
        ("1 2 3 0 0 up\n", r"line 1: expected a finite number, got 'up'"),
        ("1 2 inf 0 0 1\n", r"line 1: expected a finite number, got 'inf'"),
        ("1 2 3 0 0 1_0\n", r"line 1: expected a finite number, got '1_0'"),
        ("\n1 2 3 0 0 0\n", r"line 2: the normal of a sensor must have a length, got 0 0 0"),
        ("# none\n", "must hold sensors, got none"),
    ],
)
def test_wrong_sensors_are_refused_by_line(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"grid\.pts.*{message}"):
        load_sensors(written(tmp_path, content, name="grid.pts"))


def honeybee(folder: pathlib.Path) -> pathlib.Path:
    """A model folder as honeybee-radiance writes it."""
    files = {
        "scene/envelope.mat": WHITE,
        "scene/envelope.blk": "void plastic white 0 0 5 0 0 0 0 0\n",
        "scene/envelope.rad": room().removeprefix(WHITE),
        "aperture/aperture.mat": GLASS,
        "aperture/aperture.blk": GLASS.replace(".6 .7 .8", "0 0 0"),
        "aperture/aperture.rad": polygon(WINDOW, material="pane"),
        "aperture_group/states.json": "{}",
        "grid/room.pts": "1 1 .8 0 0 1\n",
        "grid/floor/room.pts": "1 2 .8 0 0 1\n1 3 .8 0 0 1\n",
        "grid/_info.json": "[]",
    }
    for name, content in files.items():
        written(folder / "model", content, name=name)
    return folder


@pytest.mark.parametrize("inside", [False, True])
def test_a_model_folder_has_scene_glass_and_grids(tmp_path, inside):
    folder = honeybee(tmp_path)
    scene, glass, sensors = load_honeybee(folder / "model" if inside else folder)
    assert scene.names == ["white", "pane"]
    assert glass == {"pane": pytest.approx(0.7)}
    assert float(material(scene, "white").base_color[0]) == pytest.approx(0.7)
    assert {name: len(position) for name, (position, _) in sensors.items()} == {"room": 1, "floor/room": 2}


def test_model_folders_with_states_or_without_scene_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="must be a model folder of Honeybee"):
        load_honeybee(tmp_path)
    folder = honeybee(tmp_path)
    written(folder, json.dumps({"south": [{"identifier": "0"}]}), name="model/aperture_group/states.json")
    with pytest.raises(ValueError, match=r"must have static geometry only, got .*states\.json"):
        load_honeybee(folder)


def first_hits(scene: Scene, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distance of the first surface along each ray, 1e10 for none, by testing all triangles in float64."""
    a, b, c = np.moveaxis(np.concatenate([triangles(part) for part in scene.parts]), 1, 0)
    across = np.cross(direction[:, None], c - a)
    scale = np.sum(across * (b - a), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin[:, None] - a
        u = np.sum(offset * across, -1) / scale
        other = np.cross(offset, b - a)
        v = np.sum(direction[:, None] * other, -1) / scale
        distance = np.sum((c - a) * other, -1) / scale
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0), distance, 1e10).min(1)


def test_rays_hit_what_radiance_hits(tmp_path):
    pyradiance = pytest.importorskip("pyradiance")
    home = pathlib.Path(pyradiance.__file__).parent
    environment = os.environ | {"RAYPATH": str(home / "lib")}
    shelf = np.array(L_SHAPE) * [0.5, 0.5, 1] + [1, 2, 1]
    path = written(tmp_path, room() + GLASS + polygon(WINDOW[:3], material="pane") + polygon(shelf))
    generator = np.random.default_rng(3)
    origin = generator.uniform([-2, -4, 0.1], [6, 6, 2.9], (4000, 3))
    direction = generator.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    octree = subprocess.run([home / "bin/oconv", path], check=True, capture_output=True, env=environment).stdout
    (tmp_path / "scene.oct").write_bytes(octree)
    rays = "\n".join(" ".join(map(repr, row)) for row in np.concatenate([origin, direction], 1).tolist())
    trace = [home / "bin/rtrace", "-h", "-oL", "-ab", "0", tmp_path / "scene.oct"]
    result = subprocess.run(trace, input=rays.encode(), check=True, capture_output=True, env=environment).stdout
    expected = np.array(result.split(), float)
    scene, _ = load_rad(path)
    y_up = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    distance = first_hits(scene, origin @ y_up, direction @ y_up)
    assert 0.3 < np.mean(expected < 1e9) < 0.95
    wrong = np.abs(distance - expected) > 1e-3 * expected
    assert wrong.mean() < 1e-3  # rays along edges
