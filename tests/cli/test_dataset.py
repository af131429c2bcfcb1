"""`jaxprt dataset`: pictures, cameras, manifest and shards, and sets that go on where they stopped."""

import json
import tarfile

import numpy as np
import OpenImageIO
import pytest
from click.testing import CliRunner

from jaxprt.cli.main import program
from jaxprt.scene.formats import nerf


@pytest.fixture(scope="module")
def run(place):
    """The function from options to the result of the command."""

    def dataset(output, *more, meshes=("mesh.obj",), lights="*sk*.exr"):
        options = ["--size", "16", "--light-size", "8", "--refine", "off", "--brdf", "lambert", "--system", "harmonic"]
        arguments = ["dataset", *(place / name for name in meshes), "--lights", place / lights, *options]
        return CliRunner().invoke(program, list(map(str, [*arguments, "--output", output, *more])))

    return dataset


def channels(path):
    file = OpenImageIO.ImageInput.open(str(path))
    assert file is not None
    return list(file.spec().channelnames), np.asarray(file.read_image("float"))


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """Two scenes under two lights from three cameras."""
    output = tmp_path_factory.mktemp("dataset") / "set"
    result = run(output, "--views", "3", "--layers", "color,alpha,position", meshes=("mesh.obj", "two.obj"))
    assert result.exit_code == 0, result.output
    return output


def test_each_light_is_seen_from_each_camera_of_each_scene(whole):
    rows = [json.loads(line) for line in (whole / "manifest.jsonl").read_text().splitlines()]
    assert len(rows) == 2 * 2 * 3
    assert {(row["scene"], row["light"], row["view"]) for row in rows} == {
        (scene, light, view) for scene in ("mesh", "two") for light in ("sky", "dusk") for view in range(3)
    }
    assert all((whole / row["file"]).exists() for row in rows)
    assert all(0 <= row["turn"] < 360 and row["error"] >= 0 for row in rows)
    assert len({(row["scene"], row["turn"]) for row in rows}) == 4


def test_positions_of_pictures_project_to_their_pixels_by_the_cameras_file(whole):
    content = json.loads((whole / "mesh" / "transforms.json").read_text())
    for frame in content["frames"]:
        names, values = channels(whole / "mesh" / frame["file_path"])
        assert names == ["R", "G", "B", "A", "position.X", "position.Y", "position.Z"]
        seen = values[..., 3] == 1
        assert np.count_nonzero(seen) > 10
        x, y, z = values[seen][:, 4:].T
        local = np.linalg.inv(frame["transform_matrix"]) @ np.stack([x, -z, y, np.ones_like(x)])
        focal = 0.5 * content["w"] / np.tan(0.5 * content["camera_angle_x"])
        row, column = np.nonzero(seen)
        assert np.max(np.abs(content["w"] / 2 + focal * local[0] / -local[2] - column - 0.5)) < 0.51
        assert np.max(np.abs(content["h"] / 2 - focal * local[1] / -local[2] - row - 0.5)) < 0.51


def test_a_set_goes_on_where_it_stopped_with_the_same_files(run, whole, tmp_path):
    options = ("--views", "3", "--layers", "color,alpha,position")
    assert run(tmp_path / "set", *options).exit_code == 0
    again = tmp_path / "set" / "mesh"
    before = {path.name: path.read_bytes() for path in again.iterdir()}
    for name in ("manifest.jsonl", "0001_sky.exr", "0002_sky.exr", "0002_dusk.exr"):
        (again / name).unlink()
    result = run(tmp_path / "set", *options)
    assert result.exit_code == 0
    assert {path.name: path.read_bytes() for path in again.iterdir()} == before
    assert {name: (whole / "mesh" / name).read_bytes() for name in before} == before  # whatever other scenes there are


def test_cameras_come_from_a_file_and_shards_hold_pictures_with_their_lines(run, whole, tmp_path):
    cameras = whole / "mesh" / "transforms.json"
    output = tmp_path / "set"
    options = ("--cameras", cameras, "--shards", "--format", "png", "--random-turns", "0")
    result = run(output, *options, lights="sky*")
    assert result.exit_code == 0, result.output
    count = len(nerf.load(cameras))
    with tarfile.open(output / "mesh.tar") as archive:
        names = archive.getnames()
        line = json.load(archive.extractfile(names[1]))
        first = archive.extractfile(names[0]).read()
    assert len(names) == 2 * count
    assert line == json.loads((output / "manifest.jsonl").read_text().splitlines()[0])
    assert (line["file"], line["turn"], names[1]) == (names[0], 0.0, "mesh/0000_sky.json")
    (tmp_path / "first.png").write_bytes(first)
    assert channels(tmp_path / "first.png")[1].shape == (16, 16, 4)
    assert not list((output / "mesh").glob("*.png"))
    assert run(output, *options, lights="sky*").exit_code == 0


def test_a_scene_that_fails_is_named_and_does_not_stop_others(run, tmp_path):
    result = run(tmp_path / "set", "--views", "1", meshes=("empty.obj", "mesh.obj"), lights="sky*")
    assert result.exit_code == 1
    assert "scenes that failed: 1; empty: " in result.output
    assert (tmp_path / "set" / "mesh" / "0000_sky.exr").exists()


@pytest.mark.parametrize(
    ("more", "options", "words"),
    [
        ((), {"meshes": ()}, "a dataset needs a mesh"),
        ((), {"lights": "*.hdr"}, "matches no file"),
        (("--elevations", "50,10"), {}, "--elevations must be two angles LOW,HIGH, the lower one first, got 50,10"),
        (("--elevations", "50"), {}, "--elevations must be two angles"),
        (("--format", "png", "--layers", "depth"), {}, "--layers needs --format exr, got png"),
        (("--system", "lobe,harmonic"), {}, "takes one system"),
        (("--views", "0"), {}, "must be a whole number from 1 to 100000"),
    ],
    ids=str,
)
def test_sets_that_are_none_are_refused(run, tmp_path, more, options, words):
    result = run(tmp_path / "set", *more, **options)
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())


def test_a_folder_of_another_set_is_refused(run, whole, tmp_path):
    result = run(whole, "--views", "4", "--layers", "color,alpha,position")
    assert result.exit_code == 2
    assert "views of the set in" in result.output
    (tmp_path / "other.txt").write_text("")
    result = run(tmp_path)
    assert result.exit_code == 2
    assert "--output must be an empty folder" in result.output
