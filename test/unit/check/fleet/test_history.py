"""What the recordings of a vehicle tell together, and the tables and the page of it."""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from fleets import broken, checked, moved

from calib_ros.errors import MissingDependencyError
from calib_ros_check.cli import fleet_summary
from calib_ros_check.fleet.fleet import Fleet, FleetOptions, write_changes, write_csv, write_parquet
from calib_ros_check.fleet.history import Row, row_of, utc, vehicles
from calib_ros_check.fleet.page import MOST_ROWS, change_size, plots, write_fleet_page


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """`a` turned before its seventh recording, `b` has a wrong and a broken one, `c` changed at its newest."""
    rng = np.random.default_rng(4)
    right, turned, off = moved([0] * 6), moved([0.8, 0, 0, 0, 0, 0]), moved([0, 3.0, 0, 0, 0, 0])
    answers = [checked("a", k, right if k < 6 else turned, rng) for k in range(12)]
    answers += [checked("b", k, off if k == 4 else right, rng) if k != 7 else broken("b", k) for k in range(12)]
    answers += [checked("c", k, right if k < 11 else turned, rng) for k in range(12)]
    answers += [broken("d", 0, "nothing of it <b>works</b>")]
    rows = [row_of(recording, answer) for recording, answer in answers]
    return Fleet(*vehicles([*reversed(rows)]))


def test_changes_name_vehicle_recordings_and_size(fleet: Fleet) -> None:
    assert [(c.vehicle, c.before.recording, c.after.recording, c.confirmed) for c in fleet.changes] == [
        ("a", "drive_05", "drive_06", True),
        ("c", "drive_10", "drive_11", False),
    ]
    change = fleet.changes[0]
    assert change.rotation_deg == pytest.approx(0.8, abs=0.15)
    assert change.value[0] == pytest.approx(np.deg2rad(0.8), abs=4 * np.sqrt(change.covariance[0, 0]))
    assert change.sigma[0] == pytest.approx(0.05 * np.sqrt(2 / 6), rel=0.5)
    assert re.match(r"0\.\d\d deg, \d\.\d cm: rx \+0\.\d\d deg ± 0\.0\d deg", change_size(change))


def test_rows_say_drift_changes_and_outliers(fleet: Fleet) -> None:
    rows = {(row.vehicle, row.recording): row for row in fleet.rows}
    assert [key for key, row in rows.items() if row.outlier] == [("b", "drive_04")]
    assert [key for key, row in rows.items() if row.changed] == [("a", "drive_06"), ("c", "drive_11")]
    assert rows["a", "drive_00"].drift_deg is None
    assert rows["a", "drive_06"].drift_deg == pytest.approx(0.8, abs=0.3)
    assert rows["a", "drive_06"].drift_sigma > 8
    assert rows["b", "drive_04"].drift_deg == pytest.approx(3.0, abs=0.3)
    usual = [r.drift_sigma for r in fleet.rows if r.drift_sigma is not None and not r.changed and not r.outlier]
    assert np.mean(np.array(usual) > 2) < 0.2
    assert rows["a", "drive_07"].drift_sigma < 4  # against those since the change
    assert (rows["b", "drive_07"].verdict, rows["b", "drive_07"].message) == ("error", "it is broken")
    assert rows["a", "drive_08"].verdict == "fail"
    assert rows["a", "drive_08"].errors["rx_deg"] == pytest.approx(-0.8, abs=0.3)
    assert rows["a", "drive_03"].time == "2025-10-12T08:53:20Z"
    assert list(fleet.counts) == ["fail", "error", "inconclusive", "pass"]
    assert fleet.counts["error"] == 2


def test_exit_codes() -> None:
    codes = {"pass": 0, "pass fail inconclusive error": 1, "pass inconclusive": 3, "error error": 2, "pass error": 3, "": 2}
    for verdicts, code in codes.items():
        rows = [Row("r", "v", "", verdict) for verdict in verdicts.split()]
        assert Fleet(*vehicles(rows)).exit_code == code, verdicts


def test_what_is_printed(fleet: Fleet) -> None:
    text = fleet_summary(fleet)
    assert text.splitlines()[0].startswith("37 recordings of 4 vehicles: ")
    assert "a changed between drive_05 (2025-10-14T08:53:20Z) and drive_06" in text
    assert "not confirmed, only the newest" in text
    assert ": it is broken" in text.split("  error: ")[1].splitlines()[0]


def test_times_come_from_the_data_unless_its_clock_was_never_set() -> None:
    recording, answer = checked("a", 3, moved([0] * 6), np.random.default_rng(0))
    answer["result"]["data_stamp"] = 1_500_000_000 * 10**9
    assert row_of(recording, answer).time == "2017-07-14T02:40:00Z"
    answer["result"]["data_stamp"] = 7 * 10**9
    assert row_of(recording, answer).time_ns == recording.modified_ns
    assert utc(0) == ""


def test_tables(fleet: Fleet, tmp_path: Path) -> None:
    write_csv(tmp_path / "fleet.csv", [row.values() for row in fleet.rows])
    with (tmp_path / "fleet.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert read[0].keys() == fleet.rows[0].values().keys()
    assert len(read) == 37
    assert read[0]["recording"] == "drive_00"
    assert float(read[0]["rx_deg"]) == pytest.approx(fleet.rows[0].errors["rx_deg"], rel=1e-5)
    assert (read[-1]["verdict"], read[-1]["rx_deg"], read[-1]["changed"]) == ("error", "", "false")
    write_changes(tmp_path / "changes.csv", fleet.changes)
    with (tmp_path / "changes.csv").open(newline="") as file:
        changes = list(csv.DictReader(file))
    assert [(c["vehicle"], c["after"], c["confirmed"]) for c in changes] == [
        ("a", "drive_06", "true"),
        ("c", "drive_11", "false"),
    ]
    assert float(changes[0]["rx_deg"]) == pytest.approx(0.8, abs=0.15)
    assert float(changes[0]["ty_m_sigma"]) < 0.02


def test_parquet_has_types_and_without_pyarrow_says_what_to_install(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path / "fleet.parquet", fleet.rows)
    table = parquet.read_table(tmp_path / "fleet.parquet")
    assert table.column_names == [*fleet.rows[0].values()]
    kinds = {"time_ns": "int64", "rx_deg": "double", "changed": "bool", "cause": "string"}
    assert {name: str(table.schema.field(name).type) for name in kinds} == kinds
    read = table.to_pylist()
    assert (read[0]["rotation_deg"], read[-1]["rotation_deg"]) == (fleet.rows[0].errors["rotation_deg"], None)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingDependencyError, match="pip install pyarrow"):
        write_parquet(tmp_path / "fleet.parquet", fleet.rows)


def page_of(fleet: Fleet, folder: Path) -> str:
    path = folder / "fleet.html"
    write_fleet_page(path, fleet, FleetOptions(["x"], folder), {"Command": "check x"})
    return path.read_text()


def test_page_says_it_all_without_network(fleet: Fleet, tmp_path: Path) -> None:
    page = page_of(fleet, tmp_path)
    assert not re.search(r"(src|href)=\"?(https?:)?//", page)
    summary_at, table_at = page.index('id="summary"'), page.index('id="all"')
    assert summary_at < page.index("<b>a</b> by 0.") < table_at
    assert "drive_04 (b)" in page[summary_at:table_at]
    assert page.count("<tr><td") == 37
    assert "nothing of it &lt;b&gt;works" in page
    assert page.count("<svg") == 6 * 3  # d has no estimate
    assert page.count('<line class="change"') == 6 * 2
    assert page.count(' outlier">') == 6
    shown = re.sub(r"<script>.*</script>", "", page.split("<main>")[1], flags=re.S)
    assert not re.search(r"\b(nan|inf|None)\b", shown, flags=re.I)


def test_a_large_fleet_has_a_page_of_what_wants_attention(fleet: Fleet, tmp_path: Path) -> None:
    many = [Row(f"r{k}", "v", "", "pass") for k in range(MOST_ROWS)] + [Row("bad", "v", "", "fail")]
    page = page_of(Fleet(*vehicles(many)), tmp_path)
    assert page.count("<tr><td") == MOST_ROWS
    assert ">bad</td>" in page
    assert "1 more recordings are in fleet.csv" in page


def test_plots_keep_within_their_frame(fleet: Fleet) -> None:
    for vehicle in fleet.vehicles:
        for plot in plots(vehicle, fleet.variances):
            assert len(plot["points"]) == len(vehicle.known)
            for point in plot["points"]:
                assert 0 < point["x"] < 380
                assert 18 <= point["high"] <= point["y"] <= point["low"] <= 132
    same_time = vehicles([Row("r", "v", "", "pass", path=str(k)) for k in range(3)])[0][0]
    assert plots(same_time, np.zeros(6)) == []
