"""What the paper claims, beside our figures: `verdicts` judges a record, and whether two simulators agree in it."""

from __future__ import annotations

from typing import Any, NamedTuple

from bipedtrack import metrics
from bipedtrack.record import ENGINES, Run, get, greatest_of, labels_of, mean_of, number, percent, runs_of
from bipedtrack.robot import LEGS

LASTING_SHARE = 0.95  # of the episodes must do what the paper claims without a number
LEAST_SHARE = 0.5  # of the episodes must last, or their error is none "over 10 s"
FARTHEST = 0.5  # of a step: feet that land farther off their footholds on average do not walk as they should
PARITY = (2.0, 5.0, 0.5)  # by which simulators may differ: percentage points of falls, mm and deg of ankle error
SIMULATORS = "two simulators"


class Quantity(NamedTuple):
    """An error that the paper bounds for the ankles."""

    name: str
    errors: tuple[str, ...]  # of trunk, left and right ankle, in metrics.ERRORS
    limit: float  # the paper's bound on the average
    unit: str

    @property
    def claim(self) -> str:
        """The paper's."""
        return f"average ankle {self.name} error within {self.limit:g} {self.unit}"

    @property
    def label(self) -> str:
        """Of an axis."""
        return f"{self.name.capitalize()} error, {self.unit}"

    def of_ankles(self, summary: Any, statistic: str = "mean") -> list[float | None]:
        """A statistic of left and right ankle."""
        return [get(summary, "errors", name, statistic) for name in self.errors[1:]]


class PaperFigure(NamedTuple):
    """A figure of the paper and the tasks that answer it."""

    number: int
    title: str
    tasks: tuple[str, ...]


POSITION = Quantity("position", metrics.ERRORS[:3], 5.0, "cm")
ORIENTATION = Quantity("orientation", metrics.ERRORS[3:], 5.0, "deg")
QUANTITIES = (POSITION, ORIENTATION)
ERROR_FIGURES = (
    PaperFigure(5, "Walking down stairs", ("stairs-down",)),
    PaperFigure(6, "Walking forward", ("walk-forward",)),
    PaperFigure(7, "Walking backward", ("walk-backward",)),
    PaperFigure(8, "Sidle", ("sidle-left", "sidle-right")),
    PaperFigure(9, "Turn", ("turn-left", "turn-right")),
    PaperFigure(10, "Walking up stairs", ("stairs-up",)),
)
_MOVES = tuple(task for figure in ERROR_FIGURES for task in figure.tasks)
TRAJECTORIES = PaperFigure(11, "Trajectories in different tasks", _MOVES)
BALANCE = PaperFigure(12, "Static balance, when the command stops after some task steps", ("hold-…",))
OBSTACLES = PaperFigure(13, "Obstacle avoidance", ("obstacles",))
FIGURES = (*ERROR_FIGURES, TRAJECTORIES, BALANCE, OBSTACLES)


def verdicts(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Every claim beside our figure: plain dicts, which JSON can hold.

    Keys: about ("figure 5" of the paper, or "two simulators"), task, policy, engine; claim, figure (ours) and bound, in
    words; value and limit, in unit; met, or None where nothing was measured. An error is that of the ankle with the greater
    mean. It is not met where fewer than half of the episodes last: then nothing was tracked for as long as the paper says.
    """
    runs, lines = runs_of(record), []
    for figure in ERROR_FIGURES:
        for run in runs:
            lines += _tracking(figure, run) if run.task in figure.tasks else []
    for policy in labels_of(record):
        lines += _over_all([run for run in runs if run.policy == policy and run.task in _MOVES])
    for run in runs:
        lines += _balance(run) if run.holds else []
    for run in runs:
        lines += _avoidance(run) if run.task in OBSTACLES.tasks else []
    return lines + [line for row in parities(record) for line in parity_verdicts(row)]


class _Claim(NamedTuple):
    """A bound on one of our figures that stands for something the paper says."""

    words: str
    limit: float
    unit: str
    at_least: bool = False


_UP = _Claim("achieves the task, without a fall", 100 * LASTING_SHARE, "% of episodes", at_least=True)
_KEEPS_UP = _UP._replace(words="maintains its posture: no fall")
_KEEPS_FEET = _UP._replace(words=f"maintains its posture: feet stay within {metrics.FOOT_MOVED_CM:g} cm")
_AVOIDS = _Claim("avoids obstacles: no sole comes against the side of one", 0.0, "% of swings")
_ALIKE = (
    _Claim(f"fall rates of MJX and C within {PARITY[0]:g} percentage points", PARITY[0], "percentage points"),
    _Claim(f"ankle position errors of MJX and C within {PARITY[1]:g} mm", PARITY[1], "mm"),
    _Claim(f"ankle orientation errors of MJX and C within {PARITY[2]:g} deg", PARITY[2], "deg"),
)


def _verdict(
    figure: PaperFigure, run: Run, claim: _Claim, value: float | None, but: str = "", detail: str = ""
) -> dict[str, Any]:
    """A line about a figure of the paper; `but`: why it is not met all the same, `detail`: more of our figure."""
    return _judge({"about": f"figure {figure.number}", **_names(run)}, claim, value, but, detail)


def _names(run: Run) -> dict[str, str]:
    return {"task": run.task, "policy": run.policy, "engine": run.engine}


def _judge(subject: dict[str, str], claim: _Claim, value: float | None, but: str = "", detail: str = "") -> dict[str, Any]:
    words, met = "not measured", None
    if value is not None:
        within = value >= claim.limit - 1e-9 if claim.at_least else value <= claim.limit + 1e-9
        met = within and not but
        words = f"{value:.{1 if '%' in claim.unit else 2}f} {claim.unit}"
        words += (f" ({detail})" if detail else "") + (f", but {but}" if but else "")
    return {
        **subject,
        "claim": claim.words,
        "figure": words,
        "bound": f"at {'least' if claim.at_least else 'most'} {claim.limit:g} {claim.unit}",
        **{"value": value, "limit": claim.limit, "unit": claim.unit, "met": met},
    }


def _tracking(figure: PaperFigure, run: Run) -> list[dict[str, Any]]:
    """Whether a task is tracked as the paper's are: both ankles, and nobody falls."""
    lines = []
    for quantity in QUANTITIES:
        means = quantity.of_ankles(run.summary)
        detail = ", ".join(f"{leg} {number(mean)}" for leg, mean in zip(LEGS, means, strict=True))
        claim = _Claim(quantity.claim, quantity.limit, quantity.unit)
        lines.append(_verdict(figure, run, claim, greatest_of(means), _too_short(run.lasting), detail))
    return [*lines, _verdict(figure, run, _UP, percent(run.lasting), _off_footholds(run))]


def _off_footholds(run: Run) -> str:
    """Why a task is not achieved although nobody falls: the feet do not go where they should."""
    share = get(run.summary, "touchdown", "foothold_per_step", "mean")
    return "" if share is None or share <= FARTHEST else f"feet land {100 * share:.0f} % of a step off their footholds"


def _over_all(runs: list[Run]) -> list[dict[str, Any]]:
    """The paper's summary of its figures: the mean over the tasks of figures 5 to 10, for the runs of one policy.

    Not measured where one of them was not run.
    """
    lines = []
    missing = len(_MOVES) - len({run.task for run in runs})
    for quantity in QUANTITIES if runs else ():
        legs = zip(*(quantity.of_ankles(run.summary) for run in runs), strict=True)
        claim = _Claim(f"{quantity.claim}, over all tasks", quantity.limit, quantity.unit)
        subject = runs[0]._replace(task=f"mean of {len(runs)} tasks")
        but = _too_short(mean_of(run.lasting for run in runs))
        value = None if missing else greatest_of(map(mean_of, legs))
        lines.append(_verdict(TRAJECTORIES, subject, claim, value, but))
    return lines


def _balance(run: Run) -> list[dict[str, Any]]:
    """Whether the posture is kept after a task: nobody falls, the feet stay where they are, and are where they should.

    An episode that falls before its rest has kept no foot in its place.
    """
    moved, error = get(run.summary, "rest", "foot_moved_share"), greatest_of(POSITION.of_ankles(run.summary))
    rested, episodes = get(run.summary, "rest", "episodes"), get(run.summary, "episodes")
    but = _too_short(run.lasting)
    if error is not None and error > POSITION.limit:
        but = but or f"the ankles are {error:.1f} cm off their targets on average"
    stayed = None if moved is None or not episodes else 100 * (1 - moved) * (rested or 0) / episodes
    return [_verdict(BALANCE, run, _KEEPS_UP, percent(run.lasting)), _verdict(BALANCE, run, _KEEPS_FEET, stayed, but)]


def _avoidance(run: Run) -> list[dict[str, Any]]:
    """Whether the obstacle course is walked as planned, and no foot comes against an obstacle."""
    touched, but = percent(get(run.summary, "clearance", "side_contact_share")), _too_short(run.lasting)
    if not get(run.summary, "clearance", "swings"):
        but = but or "no foot passed the edge of an obstacle"
    return [*_tracking(OBSTACLES, run), _verdict(OBSTACLES, run, _AVOIDS, touched, but)]


def _too_short(share: float | None) -> str:
    """Why an error says little, if too few episodes last."""
    return "" if share is None or share >= LEAST_SHARE else f"only {100 * share:.0f} % of episodes last to the end"


# Two simulators


class Parity(NamedTuple):
    """A task with a policy on the simulators: falls in %, errors of both ankles in cm and in deg."""

    run: Run
    values: list[dict[str, float | None]]  # of the three, by engine
    apart: list[float | None]  # MJX and C: percentage points, mm, deg; of the ankle that differs more
    both: bool  # MJX and C


def parities(record: dict[str, Any]) -> list[Parity]:
    """The tasks that more than one engine has run."""
    by_engine = {engine: {run[:2]: run for run in runs_of(record, engine)} for engine in ENGINES}
    rows = []
    for run in runs_of(record):
        of = {engine: runs[run[:2]].summary for engine, runs in by_engine.items() if run[:2] in runs}
        if len(of) < 2:
            continue
        lasting = {engine: percent(get(summary, "survival", "share")) for engine, summary in of.items()}
        values: list[dict[str, float | None]] = [{k: None if v is None else 100 - v for k, v in lasting.items()}]
        apart = [_difference(lasting.get("mjx"), lasting.get("mujoco"))]
        for quantity, scale in zip(QUANTITIES, (10, 1), strict=True):
            values.append({engine: mean_of(quantity.of_ankles(summary)) for engine, summary in of.items()})
            legs = zip(quantity.of_ankles(of.get("mjx")), quantity.of_ankles(of.get("mujoco")), strict=True)
            greatest = greatest_of(_difference(*pair) for pair in legs)
            apart.append(None if greatest is None else scale * greatest)
        rows.append(Parity(run, values, apart, "mjx" in of and "mujoco" in of))
    return rows


def parity_verdicts(row: Parity) -> list[dict[str, Any]]:
    """Falls, position and orientation, where both simulators ran."""
    subject = {"about": SIMULATORS, **_names(row.run), "engine": "mjx, mujoco"}
    return [_judge(subject, claim, value) for claim, value in zip(_ALIKE, row.apart, strict=True) if row.both]


def _difference(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else abs(one - other)
