"""Surveyed points: the map's error at them is measured, in photos and on the orthoimage, and bad tables are said."""

import json
from pathlib import Path

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from orthoswarm.evaluation.checkpoints import evaluate_checkpoints, read_checkpoints
from orthoswarm.export.product_files import write_frames
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame

EPSG = 32632
EAST, NORTH = 690_000.0, 5_330_000.0
GROUND = 1.5
LENS = Lens(1600, 1200, 1300.0, k1=-0.12, k2=0.03, cx=4.0, cy=-3.0)


def cameras() -> dict[str, Camera]:
    rng = np.random.default_rng(8)
    made = {}
    for leg in range(2):
        for k in range(5):
            turn = rotation_from_angles(np.pi * leg, np.radians(-90 + rng.normal(0, 4)), np.radians(rng.normal(0, 4)))
            at = np.array([EAST + 40.0 * leg, NORTH + 20.0 * k, 80.0 + rng.normal(0, 1)])
            made[f"uav{leg + 1}/DJI_{k:04d}.JPG"] = Camera(at, turn, LENS)
    return made


def points() -> np.ndarray:
    rng = np.random.default_rng(3)
    flat = np.column_stack([EAST + rng.uniform(0, 40, 6), NORTH + rng.uniform(10, 70, 6)])
    return np.column_stack([flat, GROUND + np.array([0.0, 3.0, -2.0, 0.0, 6.0, 1.0])])


def product(folder: Path, shift: tuple[float, float] = (0.0, 0.0)) -> Path:
    """An output folder whose cameras stand a shift from the true ones."""
    folder.mkdir(exist_ok=True)
    by = np.array([*shift, 0.0])
    placed = []
    for image, camera in cameras().items():
        frame = Frame(
            image=image,
            path=Path(image),
            vehicle=image.split("/")[0],
            time_s=None,
            fix=Fix(48.0, 11.0),
            width=LENS.width,
            height=LENS.height,
        )
        placed.append(PlacedFrame(frame, Camera(camera.position + by, camera.rotation, LENS), "fine", 0.1))
    write_frames(folder, placed, [], LocalGrid(EPSG), GROUND)
    (folder / "report.json").write_text(json.dumps({"ground_z_m": GROUND}))
    return folder


def gcp_list(path: Path, scale: float = 1.0) -> Path:
    lines = ["WGS84 UTM 32N"]
    for k, point in enumerate(points()):
        for image, camera in cameras().items():
            column, row = camera.project(point)
            if 0 <= column < LENS.width and 0 <= row < LENS.height:
                u, v = (column + 0.5) / scale - 0.5, (row + 0.5) / scale - 0.5
                lines.append(f"{point[0]:.4f} {point[1]:.4f} {point[2]:.2f} {u:.4f} {v:.4f} {image} gcp{k}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_points_that_photos_show_are_measured_whatever_their_height(tmp_path):
    out = product(tmp_path / "out")
    result = evaluate_checkpoints(out, gcp_list(tmp_path / "gcp_list.txt"))
    assert len(result.names) == 6 and result.how == "photos"
    assert np.abs(result.error).max() < 0.01  # the lens of frames.jsonl is a simpler one, right to a hundredth


def test_a_shift_of_the_map_is_the_mean_error(tmp_path):
    figures = evaluate_checkpoints(product(tmp_path / "out", (0.8, -0.3)), gcp_list(tmp_path / "gcp.txt")).figures()
    assert figures["mean_e_m"] == pytest.approx(0.8, abs=0.01)
    assert figures["mean_n_m"] == pytest.approx(-0.3, abs=0.01)
    assert figures["rmse_h_m"] == pytest.approx(np.hypot(0.8, 0.3), abs=0.01)
    assert "at least 30" in figures["statement"]


def test_points_of_larger_copies_need_their_scale(tmp_path):
    out, table = product(tmp_path / "out"), gcp_list(tmp_path / "gcp.txt", scale=0.2)
    with pytest.raises(InputError, match="--pixel-scale"):
        evaluate_checkpoints(out, table)
    assert np.abs(evaluate_checkpoints(out, table, 0.2).error).max() < 0.01


def test_points_measured_on_the_orthoimage_with_the_surveys_own_error(tmp_path):
    rng = np.random.default_rng(1)
    rows = ["name,east_m,north_m,epsg,sigma_m,map_east_m,map_north_m"]
    for k in range(40):
        east, north = EAST + rng.uniform(0, 500), NORTH + rng.uniform(0, 500)
        rows.append(f"p{k},{east:.3f},{north:.3f},{EPSG},0.03,{east + 0.2:.3f},{north - 0.1:.3f}")
    table = tmp_path / "points.csv"
    table.write_text("\n".join(rows))
    result = evaluate_checkpoints(tmp_path, table)
    assert result.rmse == pytest.approx((0.2, 0.1), abs=0.002)
    assert result.survey_m == pytest.approx(0.03 * np.sqrt(2))
    assert result.statement().startswith("tested by the ASPRS")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no points"),
        ("EPSG:32632\n", "no points below"),
        ("nowhere at all\n1 2 3 4 5 a.jpg\n", "not a coordinate system"),
        ("EPSG:32632\n1 2 3 four 5 a.jpg\n", "line 2"),
        ("name,lat_deg\na,48\n", "no coordinates"),
        ("name,lat_deg,lon_deg,image\na,48,11,x.jpg\n", "column 'column' is missing"),
        ("name,lat_deg,lon_deg,image,column,row\na,nan,11,x.jpg,1,1\n", "not a number"),
        ("name,lat_deg,lon_deg,image,column,row\na,48,11,elsewhere.jpg,1,1\n", "check the names of the images"),
        ("name,lat_deg,lon_deg\n" + "x" * 200_000 + ",47.0,8.0\n", "is no table"),
    ],
)
def test_a_bad_table_is_one_sentence(tmp_path, text, said):
    table = tmp_path / "points.txt"
    table.write_text(text)
    with pytest.raises(InputError, match=said):
        evaluate_checkpoints(product(tmp_path / "out"), table)


def test_tables_as_other_programs_write_them_are_read(tmp_path):
    table = tmp_path / "points.txt"
    table.write_text(f"EPSG:{EPSG}\n{EAST} {NORTH} NaN 10 10 a.jpg\n")
    assert [p.marks[0].image for p in read_checkpoints(table)] == ["a.jpg"]
    table.write_text("name;lat_deg;lon_deg;image;column;row\nP;48,5;11.25;a.jpg;10,5;4\n", "utf-8-sig")
    (point,) = read_checkpoints(table)
    assert point.surveyed.tolist() == [11.25, 48.5] and point.marks[0].column == pytest.approx(10.5)
    table.write_text("name,lat_deg,lon_deg,image,column,row,note;x\nP,48.5,11.25,a.jpg,10,5,\n")
    assert read_checkpoints(table)[0].surveyed.tolist() == [11.25, 48.5]
    table.write_text('name,lat_deg,lon_deg,image,column,row\nP,48.5,11.25,a.jpg,"1,234",5\n')
    with pytest.raises(InputError, match="line 2"):  # 1.234 or 1234
        read_checkpoints(table)


def test_a_name_that_two_photos_have_is_asked_about(tmp_path):
    out = product(tmp_path / "out")
    table = tmp_path / "gcp.txt"
    table.write_text(f"EPSG:{EPSG}\n{EAST} {NORTH} 0 10 10 DJI_0000.JPG\n")
    with pytest.raises(InputError, match="with their folders"):
        evaluate_checkpoints(out, table)


def test_the_command_prints_the_contract(tmp_path, capsys):
    out, table = product(tmp_path / "out"), gcp_list(tmp_path / "gcp.txt")
    assert main(["evaluate", str(out), "--checkpoints", str(table), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["checkpoints"] == 6
    assert {"rmse_e_m", "rmse_n_m", "rmse_h_m"} <= set(figures)
    assert main(["evaluate", str(out)]) == 2
    assert "--checkpoints" in capsys.readouterr().err


def test_real_control_points_are_read(real_data):
    points = read_checkpoints(real_data("sheffield_cross_800") / "gcp_file_4000px.txt", 0.2)
    assert len(points) == 5 and all(len(p.marks) == 5 for p in points)


def test_points_of_one_name_at_several_places_are_several_points(tmp_path):
    table = gcp_list(tmp_path / "gcp.txt")
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0], *(line.rsplit(" ", 1)[0] + " GCP" for line in lines[1:])]))
    result = evaluate_checkpoints(product(tmp_path / "out"), table)
    assert result.names == [f"GCP ({k})" for k in range(1, 7)]
    assert np.abs(result.error).max() < 0.01 and result.findings == []
    table = tmp_path / "points.csv"
    table.write_text("name,lat_deg,lon_deg,image,column,row\n" + "".join(
        f"P,{lat},11,DJI_{k:04d}.JPG,1,1\n" for k, lat in enumerate((48.0, 48.0, 48.001)))
    )  # fmt: skip
    assert [(p.name, len(p.marks)) for p in read_checkpoints(table)] == [("P (1)", 2), ("P (2)", 1)]


def test_a_mark_that_the_others_contradict_is_left_out_and_told(tmp_path, capsys):
    table = gcp_list(tmp_path / "gcp.txt")
    lines = table.read_text().splitlines()
    own = [i for i, line in enumerate(lines) if line.endswith("gcp0")]
    assert len(own) > 2
    words = lines[own[0]].split()
    words[3] = str(float(words[3]) + (100.0 if float(words[3]) < 800 else -100.0))
    lines[own[0]] = " ".join(words)
    table.write_text("\n".join(lines))
    out = product(tmp_path / "out")
    result = evaluate_checkpoints(out, table)
    assert np.abs(result.error).max() < 0.02
    assert len(result.findings) == 1 and f"mark in {words[5]} was left out" in result.findings[0]

    table.write_text(
        "\n".join([lines[0], *(lines[i] for i in own[:2])])
    )  # of two rays none is known to be the wrong one
    result = evaluate_checkpoints(out, table)
    assert "contradict each other" in result.findings[0] and result.miss_m[0] > 1.0
    assert main(["evaluate", str(out), "--checkpoints", str(table)]) == 0
    assert "contradict each other" in capsys.readouterr().out


def rewritten(path: Path, header: str, turned) -> Path:
    """The points of `gcp_list` under another header, their two coordinates turned by a function of east and north."""
    _, *rows = gcp_list(path).read_text().splitlines()
    lines = [header]
    for row in rows:
        east, north, rest = row.split(" ", 2)
        x, y = turned(float(east), float(north))
        lines.append(f"{x:.9f} {y:.9f} {rest}")
    path.write_text("\n".join(lines) + "\n")
    return path


def degrees(east, north):
    lat, lon = LocalGrid(EPSG).to_geographic([east, north]).tolist()
    return lon, lat


@pytest.mark.parametrize(
    ("header", "turned", "said"),
    [
        ("EPSG:4326", lambda e, n: degrees(e, n)[::-1], "two coordinates exchanged"),
        ("WGS84 UTM 32N", lambda e, n: (n, e), "two coordinates exchanged"),
        ("WGS84 UTM 32S", lambda e, n: (e, n), "EPSG:32632 instead of WGS84 UTM 32S"),
        ("EPSG:32633", lambda e, n: (e, n), "EPSG:32632 instead of EPSG:32633"),
        ("EPSG:32632", degrees, "EPSG:4326 instead of EPSG:32632"),
        ("EPSG:4326", lambda e, n: (-degrees(e, n)[0], degrees(e, n)[1]), "a minus before its longitude"),
        ("EPSG:32632", lambda e, n: (e + 40_000.0, n), "check their coordinates"),
    ],
)
def test_points_elsewhere_are_refused_with_what_was_meant(tmp_path, header, turned, said, capsys):
    out, table = product(tmp_path / "out"), rewritten(tmp_path / "gcp.txt", header, turned)
    assert main(["evaluate", str(out), "--checkpoints", str(table), "--json"]) == 2
    told = capsys.readouterr()
    assert said in told.err and told.out == "" and "inf" not in told.err


def test_one_point_elsewhere_is_told_and_the_others_are_measured(tmp_path):
    table = gcp_list(tmp_path / "gcp.txt")
    table.write_text(table.read_text().replace(f"{points()[2, 1]:.4f}", f"{points()[2, 1] + 70_000.0:.4f}"))
    result = evaluate_checkpoints(product(tmp_path / "out"), table)
    assert np.abs(result.error).max() < 0.01
    assert result.unused == ["gcp2"] and "70 km" in " ".join(result.findings)


def test_a_point_that_stands_out_and_a_shift_of_all_are_told(tmp_path):
    table = gcp_list(tmp_path / "gcp.txt")
    table.write_text(table.read_text().replace(f"{points()[2, 1]:.4f}", f"{points()[2, 1] + 70.0:.4f}"))
    assert any("point gcp2" in f and "70 m" in f for f in evaluate_checkpoints(product(tmp_path / "a"), table).findings)
    moved = evaluate_checkpoints(product(tmp_path / "b", (60.0, 75.0)), gcp_list(tmp_path / "gcp.txt"))
    assert any("another datum" in finding for finding in moved.findings)


@pytest.mark.parametrize(
    "system", ["+proj=utm +zone=32 +ellps=bessel +units=m +no_defs", "+proj=utm +zone=32 +ellps=intl +units=m"]
)
def test_an_ellipsoid_without_a_datum_is_refused(tmp_path, system):
    table = rewritten(tmp_path / "gcp.txt", system, lambda e, n: (e, n))
    with pytest.raises(InputError, match=r"names the ellipsoid .* but no datum"):
        evaluate_checkpoints(product(tmp_path / "out"), table)


@pytest.mark.parametrize(
    ("system", "said"),
    [
        ("+proj=utm +zone=32 +ellps=WGS84 +units=m", "WGS 84 is assumed"),
        ("EPSG:31468", "to 3 m only"),
        ("EPSG:25832", ""),
        ("EPSG:32632+5773", ""),
    ],
)
def test_what_is_not_known_of_a_datum_is_told(tmp_path, system, said):
    table = tmp_path / "points.csv"
    east, north = (4_468_500.0, 5_333_000.0) if system == "EPSG:31468" else (EAST, NORTH)
    table = tmp_path / "gcp.txt"
    table.write_text(f"{system}\n{east} {north} 0 10 10 a.jpg\n")
    (point,) = read_checkpoints(table)
    assert said in point.doubt and bool(said) == bool(point.doubt)


def test_a_negative_sigma_is_refused(tmp_path):
    table = tmp_path / "points.csv"
    table.write_text("name,lat_deg,lon_deg,sigma_m,map_lat_deg,map_lon_deg\na,48,11,-0.1,48,11\n")
    with pytest.raises(InputError, match="cannot be less than 0"):
        read_checkpoints(table)


@pytest.mark.parametrize("name,code", [("PUWG1992", "EPSG:2180"), ("Lambert93", "EPSG:2154"), ("NZTM", "EPSG:2193")])
def test_the_code_of_a_system_that_is_called_otherwise_is_proposed(tmp_path, name, code):
    (tmp_path / "gcp_list.txt").write_text(f"{name}\n634676 485344 112 242.0 256.9 a.jpg\n")
    with pytest.raises(InputError, match=f"if it is {code} .*, write that code"):
        read_checkpoints(tmp_path / "gcp_list.txt")


def test_of_a_name_that_fits_several_systems_or_none_nothing_is_proposed(tmp_path):
    for name in ("Poland", "xyzzy"):
        (tmp_path / "gcp_list.txt").write_text(f"{name}\n634676 485344 112 242.0 256.9 a.jpg\n")
        with pytest.raises(InputError, match="write EPSG:32617 or a PROJ string"):
            read_checkpoints(tmp_path / "gcp_list.txt")
