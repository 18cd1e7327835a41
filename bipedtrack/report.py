"""What an evaluation found as one HTML file: style and figures within, no script, nothing from any other address.

`page` is the table of contents. It takes what `evaluate.run` returns; whatever is missing there is left out, or said to be
missing.
"""

from __future__ import annotations

import math
import shlex
from typing import Any

from bipedtrack import comparisons, falls, markup, metrics, sheets, swings, verdicts
from bipedtrack.markup import escape, section
from bipedtrack.record import ENGINES, engines_of, get, labels_of, number


def page(record: dict[str, Any]) -> str:
    """The whole report as HTML."""
    found, title = verdicts.verdicts(record), escape(", ".join(labels_of(record).values())) or "no policy"
    sections = (
        _glance(record, found),
        sheets.tables(record),
        sheets.intervals(record),
        sheets.levels(record),
        comparisons.paper(record, found),
        comparisons.simulators(record),
        comparisons.robustness(record),
        _origins(record),
    )
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<link rel="icon" href="data:,">\n'
        f"<title>bipedtrack evaluation: {title}</title>\n<style>{markup.CSS}</style>\n</head>\n<body>\n"
        f"<header>\n<h1>Tracking of trunk and ankles: {title}</h1>\n{_header(record)}\n</header>\n"
        "<main>\n" + "\n".join(sections) + "\n</main>\n</body>\n</html>\n"
    )


def _header(record: dict[str, Any]) -> str:
    """What was evaluated, how, and where to find it."""
    options = get(record, "options") or {}
    facts = {
        "Policies": escape(", ".join(labels_of(record).values())) or "none",
        "Tasks": len(get(record, "tasks") or {}),
        **{f"{name.capitalize()} of each task": escape(options.get(name, "–")) for name in ("episodes", "seconds")},
        "Seed": escape(options.get("seed", "–")),
        "Simulators": "; ".join(ENGINES[engine] for engine in engines_of(record)) or "none",
    }
    listed = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts.items())
    links = {
        **{"glance": "At a glance", "tables": "Every figure", "intervals": "Side by side"},
        **{"levels": "From easy to hard", "paper": "Against the paper"},
        **{"simulators": "Two simulators", "robustness": "Robustness", "origins": "Ranges, options, versions, provenance"},
    }
    menu = "".join(f'<a href="#{anchor}">{name}</a>' for anchor, name in links.items())
    return (
        f'<dl class="facts">{listed}</dl>\n{_command(options)}<nav aria-label="Contents">{menu}</nav>\n'
        f"<details><summary>How each figure is defined</summary>{_DEFINITIONS}</details>"
    )


def _command(options: dict[str, Any]) -> str:
    """The command line that evaluates the same again."""
    if not options.get("policies"):
        return ""
    words = ["python", "-m", "bipedtrack.evaluate", *options["policies"]]
    for name, value in options.items():
        flag = name.replace("_", "-")
        if name in ("feedforward", "robustness"):  # flags, on and off by default
            words += [] if value == (name == "feedforward") else [f"--{flag}" if value else f"--no-{flag}"]
        elif name not in ("policies", "out") and value not in (None, [], ()):
            words += [f"--{flag}", *(map(str, value) if isinstance(value, list | tuple) else (str(value),))]
    return f"<p>Made by <code>{escape(shlex.join(words))}</code></p>\n"


def _glance(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """How many claims each policy meets."""
    columns = {f"figure {f.number}": f'<a href="#figure-{f.number}">figure {f.number}</a>' for f in verdicts.FIGURES}
    columns[verdicts.SIMULATORS] = f'<a href="#simulators">{verdicts.SIMULATORS}</a>'
    rows = []
    for policy, label in labels_of(record).items():
        cells = [_count([v["met"] for v in found if (v["policy"], v["about"]) == (policy, about)]) for about in columns]
        rows.append(f'<tr><th scope="row">{escape(label)}</th>{"".join(cells)}</tr>')
    table = markup.table("Claims met, of those that were measured", markup.head("Policy", *columns.values()), rows)
    return section("glance", "At a glance", table)


def _count(met: list[bool | None]) -> str:
    """A cell: how many are met."""
    measured = [one for one in met if one is not None]
    kind = "unknown" if not measured else "met" if all(measured) else "missed"
    words = f"{markup.MARKS[kind]} {sum(measured)} of {len(measured)}" if measured else "–"
    return f'<td class="{kind}">{words}</td>'


def _origins(record: dict[str, Any]) -> str:
    """What the tasks are drawn from, the options, the versions and where the policies come from."""
    ranges = [
        f'<tr><th scope="row">{escape(task)}</th><td class="words">{escape(get(entry, "ranges") or "–")}</td>'
        f"<td>{number(get(entry, 'seconds'), 1)}</td></tr>"
        for task, entry in (get(record, "tasks") or {}).items()
    ]
    table = markup.table("What the episodes are drawn from", markup.head("Task", "Ranges", "Seconds"), ranges, "left")
    versions, options = (_tree(get(record, name) or {}) for name in ("versions", "options"))
    provenance = [
        f"<details><summary>{escape(name)}</summary>{_tree(origin) if origin else '<p>Nothing was trained.</p>'}</details>"
        for name, origin in (get(record, "policies") or {}).items()
    ]
    lists = f'<div class="pair"><div><h3>Versions</h3>{versions}</div><div><h3>Options</h3>{options}</div></div>'
    policies = f"<h3>Provenance of the policies</h3>{''.join(provenance) or '<p>Not recorded.</p>'}"
    return section("origins", "Ranges, options, versions, provenance", table + lists + policies)


def _tree(value: Any) -> str:
    """Nested dicts as nested lists of names and values."""
    if not isinstance(value, dict):
        words = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
        return "not set" if words in (None, "") else escape(words)
    items = "".join(f"<li><b>{escape(key)}</b>: {_tree(part)}</li>" for key, part in value.items())
    return f"<ul>{items}</ul>" if items else "none"


_DEFINITIONS = f"""<ul>
<li><b>Error</b>: distance of a node from its real-time target of the same instant, at each control step before a fall, in
cm; yaw of the ankles and whole rotation of the trunk, in deg. Mean, median, 95th percentile (95 %) and maximum are over all
steps of all episodes, of a hold those before it, too; over time, the mean over the robots that have not fallen.</li>
<li><b>Without a fall</b>: share of episodes that last to the end, with Wilson's 95 % interval. A fall is a trunk tilted by
{math.degrees(falls.TILT):.0f} deg or {falls.DEPTH:g} m below its target, or an ankle {falls.LOST_ANKLE:g} m off its own.
Time to fall: mean of those that fall; median of all, if more than half of them fall.</li>
<li><b>Interval of an error</b>: of the mean over the means of the episodes, by Student's t.</li>
<li><b>Footholds</b>: the ankle against its foothold at the planned instant, whether the foot is down or not; a foot that
is to stay in the air has none. The time is when the ground first bears more than {100 * metrics.CONTACT_SHARE:g} % of the
weight, from the middle of the swing to half a swing after its planned end; else the touchdown is missed. No error is
divided by a step of {100 * swings.LEAST_STEP:g} cm or less.</li>
<li><b>Clearance</b>: least height of a corner of the sole over the edge of a tread or obstacle as it passes that edge. A
swing is against a side if a corner comes within {1000 * swings.SIDE_REACH:g} mm of it,
{1000 * swings.SIDE_DEPTH:g} mm or more below its edge.</li>
<li><b>Rest</b>: from {metrics.SETTLE:g} s after the command came to stand still. Joint speed RMS is over all joints, sway of
the trunk in the plane about its mean; a foot has moved if it was more than {metrics.FOOT_MOVED_CM:g} cm off where it
stood.</li>
<li><b>Effort</b>: torques as applied, saturated from {100 * metrics.SATURATION:g} % of the limit; power is the sum of
|torque times joint speed|.</li>
</ul>"""
