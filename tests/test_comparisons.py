"""A report's verdicts on the paper's claims, its two simulators beside each other, and its disturbances."""

from typing import Any

from reports import Reader, drop, put, summaries

from bipedtrack import report, verdicts


def test_two_simulators_stand_beside_each_other(record: dict[str, Any]) -> None:
    for engine, (share, cm, deg) in {"mjx": (0.9, 1.0, 1.0), "mujoco": (0.87, 1.2, 1.4), "converged": (0.8, 3, 4)}.items():
        summary = summaries(record, "stand")[engine]
        summary["survival"]["share"] = share
        summary["errors"]["left_ankle_position_cm"]["mean"] = summary["errors"]["right_ankle_position_cm"]["mean"] = cm
        summary["errors"]["left_ankle_yaw_deg"]["mean"], summary["errors"]["right_ankle_yaw_deg"]["mean"] = deg, 1.0
    row = Reader(report.page(record)).rows("MJX beside C", "stand", "ik")[0]
    assert row[2:6] == ["10.0", "13.0", "3.0", "20.0"]
    assert row[6:10] == ["1.00", "1.20", "2.00", "3.00"]
    assert row[10:14] == ["1.00", "1.20", "0.40", "2.50"]
    assert row[14].split() == ["✗", "not", "met", "falls"]


def test_one_engine_alone_is_not_compared(record: dict[str, Any]) -> None:
    drop(record, "mjx")
    page = Reader(report.page(record))
    assert page.rows("MJX beside C", "stand", "ik")[0][2:6] == ["–", "25.0", "–", "25.0"]
    assert page.rows("MJX beside C", "stand", "ik")[0][-1].strip() == "? not measured"
    drop(record, "converged")
    assert "Only one simulator was evaluated" in " ".join(Reader(report.page(record)).text)


def test_robustness_has_its_curves_and_numbers(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    row = page.rows("Survival, and mean errors of both", "push", "ik")[1]
    assert row[2:] == ["17.5 N s", "75.0 [30.1, 95.4]", "2.50", "2.00"]
    labels = [names["aria-label"] or "" for tag, names in page.tags if tag == "svg" and "aria-label" in names]
    assert any(label.startswith("Without a fall, %, over push in N s: 0: 75.00; 17.5: 75.00") for label in labels)
    assert any(label.startswith("Ankle position error, cm, over push in N s: 0: 2.50; 17.5: 2.50") for label in labels)


def test_every_verdict_stands_in_a_table_with_its_badge(record: dict[str, Any]) -> None:
    put(summaries(record, "hold-walk-forward")["mjx"], "rest.foot_moved_share", None)
    found = [verdict for verdict in verdicts.verdicts(record) if verdict["about"] != verdicts.SIMULATORS]
    badges = {True: "✓ met", False: "✗ not met", None: "? not measured"}
    assert {verdict["met"] for verdict in found} == set(badges)
    labels = {"runs/best/policy.npz": "best", "ik": "ik"}
    rows = [row for row in Reader(report.page(record)).rows("Verdicts") if row[0] != "Task"]
    assert rows == [[v["task"], labels[v["policy"]], v["claim"], v["figure"], v["bound"], badges[v["met"]]] for v in found]
