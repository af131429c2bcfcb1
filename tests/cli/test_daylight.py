"""The command `jaxprt daylight`: a building, weather and sensors become tables and pictures."""

import csv
import json

import pytest

ROOM = """void plastic gray 0 0 5 .5 .5 .5 0 0
gray polygon floor 0 0 12 0 0 0 4 0 0 4 4 0 0 4 0
gray polygon wall 0 0 12 0 4 0 4 4 0 4 4 3 0 4 3
void glass pane 0 0 3 .9 .9 .9
pane polygon window 0 0 12 0 0 0 4 0 0 4 0 3 0 0 3
"""
WEATHER = "place Munich\nlatitude 48.1\nlongitude -11.6\ntime_zone -15\nsite_elevation 0\nweather_data_file_units 1\n"
WEATHER += "".join(f"6 21 {hour + 0.5} 600 150\n" for hour in range(6, 18))
OBJECT = "v -9 -1 -9\nv -9 -1 9\nv 9 -1 9\nv 9 -1 -9\nf 1 2 3 4\n"


@pytest.fixture
def building(tmp_path):
    (tmp_path / "room.rad").write_text(ROOM)
    (tmp_path / "day.wea").write_text(WEATHER)
    (tmp_path / "desk.pts").write_text("".join(f"{x} {y} .8 0 0 1\n" for x in (1, 2, 3) for y in (1, 2, 3)))
    (tmp_path / "plane.obj").write_text(OBJECT)
    return tmp_path


def run(main, building, name, *options):
    files = [building / name for name in (name, "day.wea", "desk.pts")]
    return main("daylight", *files, "--output", building / "out", "--rays", "8", *options)


def test_a_room_gets_tables_and_pictures(main, building, capsys):
    assert run(main, building, "room.rad", "--bounces", "1", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["place"] == "Munich"
    assert told["grids"]["desk"]["sensors"] == 9
    with open(building / "out" / "desk.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(0 < float(row["daylight_factor_percent"]) < 100 for row in rows)
    assert len(list((building / "out").glob("desk_*.png"))) == 3


def test_parts_of_a_job_array_share_a_folder(main, building, capsys):
    assert run(main, building, "plane.obj", "--bounces", "0", "--part", "1/2") == 0
    assert "part 1/2 of" in capsys.readouterr().out
    assert run(main, building, "plane.obj", "--bounces", "0", "--part", "2/2") == 0
    assert "desk: sensors 9, sDA_300_50 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["room.rad", "desk.pts"], "one weather file, got 1 and 0"),
        (["room.rad", "plane.obj", "day.wea", "desk.pts"], "one building (a model, files of Radiance, or a folder of"),
        (["room.rad", "day.wea"], "daylight needs sensors"),
    ],
)
def test_missing_files_are_named(main, building, capsys, files, message):
    assert main("daylight", *(building / name for name in files)) == 2
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--part", "3/2"), "the part must be from 1/2 to 2/2, got 3/2"),
        (("--glass", "pane"), "must be a part and its transmissivity, such as window=.88, got 'pane'"),
        (("--glass", "door=.9"), "glass must name parts of the scene, got 'door'"),
    ],
)
def test_wrong_options_say_what_is_required(main, building, capsys, option, message):
    assert run(main, building, "room.rad", *option) == 2
    assert message in " ".join(capsys.readouterr().err.split())
