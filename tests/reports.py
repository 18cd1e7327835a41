"""What the tests of a report share: a record made by hand, what may be missing of it, and a reader of pages."""

import html.parser
import json
import re
from typing import Any

import numpy as np

from bipedtrack import metrics, verdicts
from bipedtrack.nodes import Nodes
from bipedtrack.record import ENGINES
from bipedtrack.robot import Robot
from bipedtrack.swings import Boxes
from bipedtrack.trace import Trace

DT = 0.005  # s
WEIGHT = 400.0  # N
MOVES = [task for figure in verdicts.ERROR_FIGURES for task in figure.tasks]
TASKS = ("stand", *MOVES, "hold-squat", "hold-walk-forward", "obstacles", "composite")
PARTS = (  # which `drop` takes away
    *("options", "versions", "policies", "tasks", "robustness", "mjx", "mujoco", "converged", "course", "path", "levels"),
    *("numbers", "clearance", "points", "walk-forward", "hold-squat", "composite", "none of the tasks", "one policy"),
)


def steps(episodes: int = 4, n: int = 600) -> Trace:
    """Robots that walk along x at 0.2 m/s: feet (0.03, 0.02) m beside their targets, the last one falls at the end."""
    feet = np.array([[0, 0.1, 0.04], [0, -0.1, 0.04]])
    ones, time = np.ones((episodes, n)), np.arange(n) * DT
    moved = ones[..., None] * np.where(time < 1.5, 0.2 * time, 0.3)[None, :, None] * np.array([1.0, 0, 0])

    def nodes(off: float, turned: float) -> Nodes:
        return Nodes(
            trunk_position=moved + [0, 2 * off, 0.75],
            trunk_orientation=ones[..., None] * [1, 0, 0, 0],
            ankle_positions=moved[..., None, :] + feet + np.array([[0, off, 0], [0, off * 2 / 3, 0]]),
            ankle_yaws=np.full((episodes, n, 2), np.radians(turned)),
        )

    joints = np.zeros((episodes, n, 12))
    still = np.broadcast_to(time >= 1.5, (episodes, n)).copy()
    timer, forces = np.zeros((episodes, n, 2)), np.full((episodes, n, 2), WEIGHT / 2)
    timer[:, 100:200, 0], forces[:, 100:205, 0] = np.arange(100, 0, -1) * DT, 0
    alive = np.ones((episodes, n), bool)
    alive[-1, -50:] = False
    measured = nodes(0.03, 2.0)
    qpos = np.concatenate([measured.trunk_position, measured.trunk_orientation, joints], axis=-1)
    speeds = np.full((episodes, n, 18), 0.1)
    return Trace(time, qpos, speeds, nodes(0, 0), measured, timer, still, joints, joints, joints + 1, forces, alive)


def result(trace: Trace, robot: Robot) -> dict[str, Any]:
    """What an evaluation keeps of a trace."""
    episodes = len(trace.alive)
    # a bar 1 cm high, through which the toes slide
    place = [0.15 + robot.sole[0] / 2, 0.1, 0.005]
    bar = np.tile(place, (episodes, 1, 1)), np.tile([0.01, 0.5, 0.005], (episodes, 1, 1))
    boxes = Boxes(*bar, np.zeros((episodes, 1)))
    course = {name: values[::10].round(4).tolist() for name, values in metrics.time_course(trace).items()}
    path: dict[str, Any] = {"time_s": course["time_s"]}
    for side, state in (("target", trace.target), ("measured", trace.measured)):
        nodes = {
            "trunk": state.trunk_position[0],
            "left": state.ankle_positions[0, :, 0],
            "right": state.ankle_positions[0, :, 1],
        }
        path[side] = {node: points[::10].round(4).tolist() for node, points in nodes.items()}
    levels = [{"label": f"{i} cm a step", **metrics.outline(trace.episode(np.array([i, 3])))} for i in range(2)]
    return {"summary": metrics.summarise(trace, robot, WEIGHT, boxes), "course": course, "path": path, "levels": levels}


def make(robot: Robot) -> dict[str, Any]:
    """A record of two policies on three engines, with robustness."""
    one = result(steps(), robot)
    options = {
        "policies": ["runs/best/policy.npz", "ik"],
        "tasks": list(TASKS),
        "script": None,
        "episodes": 4,
        "seconds": 3.0,
    }
    options |= {
        "engine": "both",
        "seed": 2024,
        "out": "evaluation",
        "robustness": True,
        "feedback_ratio": None,
        "filter": 0.1,
    }
    options |= {"velocity_feedforward": None, "gravity_feedforward": None, "integral": None, "feedforward": True}
    results = {name: dict.fromkeys(ENGINES, one) for name in options["policies"]}
    levels = [{"level": v, "survival": one["summary"]["survival"], "errors": one["summary"]["errors"]} for v in (0.0, 17.5)]
    ladder = {"unit": "N s", "levels": levels, "episodes": 4, "task": "walk-forward"}
    return {
        "options": options,
        "versions": {"mujoco": "3.17.0", "jax": "0.9.2"},
        "policies": {"runs/best/policy.npz": {"curriculum": "paper", "seed": 3}, "ik": {}},
        "tasks": {task: {"ranges": f"ranges of {task}", "seconds": 3.0, "policies": results} for task in TASKS},
        "robustness": {"ik": {"push": ladder}},
    }


class Reader(html.parser.HTMLParser):
    """Ids, links, tables and the tree of a page; fails where tags do not match."""

    EMPTY = ("meta", "link")

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: list[tuple[str, list[list[str]]]] = []  # caption and rows
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = dict(attrs)
        self.tags.append((tag, names))
        self.ids += [names["id"] or ""] if "id" in names else []
        self.links += [names["href"] or ""] if tag == "a" else []
        if tag == "table":
            self.tables.append(("", []))
        if tag == "tr":
            self.tables[-1][1].append([])
        if tag in ("td", "th"):
            self.tables[-1][1][-1].append("")
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)
        if "caption" in self.open:
            self.tables[-1] = (self.tables[-1][0] + data, self.tables[-1][1])
        elif {"td", "th"} & set(self.open):
            self.tables[-1][1][-1][-1] += data

    def rows(self, caption: str, *names: str) -> list[list[str]]:
        """The rows of the tables of that caption that begin with these cells."""
        tables = [rows for title, rows in self.tables if title.startswith(caption)]
        assert tables, caption
        return [row for rows in tables for row in rows if row[: len(names)] == list(names)]

    def named(self, tag: str, kind: str) -> list[dict[str, str | None]]:
        """The attributes of the tags of that class."""
        return [names for found, names in self.tags if found == tag and kind in (names.get("class") or "").split()]


def copied(record: dict[str, Any]) -> dict[str, Any]:
    """The same for a test to change; nothing in it is shared."""
    return json.loads(json.dumps(record))  # a deep copy would keep what is shared within


def summaries(record: dict[str, Any], task: str, policy: str = "ik") -> dict[str, Any]:
    return {engine: one["summary"] for engine, one in record["tasks"][task]["policies"][policy].items()}


def put(summary: dict[str, Any], path: str, value: float | None) -> None:
    *parents, last = path.split(".")
    for key in parents:
        summary = summary[key]
    summary[last] = value


def emptied(tree: Any) -> Any:
    """The same with every number None."""
    if isinstance(tree, dict):
        return {key: emptied(value) for key, value in tree.items()}
    return None if isinstance(tree, int | float) else tree


def each(record: dict[str, Any]) -> list[dict[str, Any]]:
    """What every engine found for every task and policy."""
    policies = [results for entry in record["tasks"].values() for results in entry["policies"].values()]
    return [one for results in policies for one in results.values()]


def drop(record: dict[str, Any], what: str) -> None:
    """Takes a part away."""
    if what in record:
        del record[what]
    elif what in ("mjx", "mujoco", "converged"):
        for entry in record["tasks"].values():
            for results in entry["policies"].values():
                del results[what]
    elif what in ("course", "path", "levels"):
        for one in each(record):
            del one[what]
    elif what == "one policy":
        for task in MOVES[2:]:
            del record["tasks"][task]["policies"]["ik"]
    elif what == "numbers":
        for one in each(record):
            one["summary"] = emptied(one["summary"])
            one["course"] = {name: [None] * len(v) if name != "time_s" else v for name, v in one["course"].items()}
    elif what == "clearance":
        for one in each(record):
            one["summary"]["clearance"] = None
    elif what == "points":
        for one in each(record):
            one["path"]["target"] = {}
            one["path"]["measured"] = {"left": [[0, 0, 0]]}
    else:
        record["tasks"] = {name: entry for name, entry in record["tasks"].items() if name == what}


def numbers(steps: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", steps)]
