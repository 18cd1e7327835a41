"""The pieces that a report is made of, in HTML, and their style."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from typing import Any

MARKS = {"met": "✓", "missed": "✗", "unknown": "?"}
_WORDS = {"met": "met", "missed": "not met", "unknown": "not measured"}


def escape(text: Any) -> str:
    return html.escape(str(text), quote=True)


def section(anchor: str, title: str, content: str) -> str:
    return f'<section id="{anchor}">\n<h2>{escape(title)}</h2>\n{content}\n</section>'


def table(title: str, head: str, rows: Sequence[str], kind: str = "") -> str:
    """A table that scrolls by itself where it is wider than the page; empty without rows."""
    if not rows:
        return ""
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(title)}"><table class="{kind}"><caption>'
        f"{escape(title)}</caption><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table></div>\n"
    )


def head(*headings: str) -> str:
    return "<tr>" + "".join(f'<th scope="col">{heading}</th>' for heading in headings) + "</tr>"


def two_heads(groups: dict[str, int], headings: Sequence[str], last: str = "") -> str:
    """Headings of groups by their number of columns, above those of the columns."""
    wide = "".join(f'<th scope="colgroup" colspan="{count}">{escape(name)}</th>' for name, count in groups.items())
    names = '<th scope="col" rowspan="2">Task</th><th scope="col" rowspan="2">Policy</th>'
    end = f'<th scope="col" rowspan="2">{last}</th>' if last else ""
    return f"<tr>{names}{wide}{end}</tr>{head(*headings)}"


def task_rows(lines: Iterable[tuple[str, str, Sequence[str]]]) -> list[str]:
    """Rows of a task, a policy's label and further cells, with a rule above each task."""
    rows, before = [], None
    for task, label, cells in lines:
        first, before = ("" if task == before else ' class="first"'), task
        names = f'<th scope="row">{escape(task)}</th><td class="name">{escape(label)}</td>'
        rows.append(f"<tr{first}>{names}{''.join(cells)}</tr>")
    return rows


def figure(kind: str, panels: Iterable[str], caption: str) -> str:
    parts = "".join(f"<div>{panel}</div>" for panel in panels)
    return f'<figure><div class="{kind}">{parts}</div><figcaption>{caption}</figcaption></figure>\n'


def badge(met: bool | None) -> str:
    kind = "unknown" if met is None else "met" if met else "missed"
    return f'<span class="badge {kind}">{MARKS[kind]} {_WORDS[kind]}</span>'


CSS = """
:root{color-scheme:light;--ink:#1c2430;--soft:#5a6675;--rule:#d5dbe3;--pale:#f4f6f9;--trunk:#59626e;--left:#0072b2;
--right:#c2500a;--target:#0a8a3c;--actual:#ffd21f;--casing:#5b4300}
*{box-sizing:border-box}
body{margin:0 auto;padding:16px 20px 48px;max-width:1200px;color:var(--ink);background:#fff;overflow-wrap:break-word;
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Liberation Sans","DejaVu Sans",sans-serif}
h1{font-size:26px;line-height:1.2;margin:8px 0 14px}
h2{font-size:21px;margin:40px 0 10px;padding-top:10px;border-top:2px solid var(--ink)}
h3{font-size:17px;margin:30px 0 8px}h4{font-size:13px;margin:6px 0 2px}ul{padding-left:20px;margin:6px 0}li{margin:3px 0}
a{color:#0b5cad}code{background:var(--pale);padding:2px 5px;border-radius:3px;font-size:13px;overflow-wrap:anywhere}
.facts{display:flex;flex-wrap:wrap;gap:6px 28px;margin:0}.facts dt{font-size:12px;color:var(--soft)}.facts dd{margin:0}
nav{display:flex;flex-wrap:wrap;gap:4px 18px;margin:10px 0;padding:8px 0;border:solid var(--rule);border-width:1px 0}
details{margin:8px 0}summary{cursor:pointer;font-weight:600;padding:4px 0}
.scroll{overflow-x:auto;margin:14px 0 22px}small{color:var(--soft);font-size:11px}
table{border-collapse:collapse;font-size:12.5px;line-height:1.35;font-variant-numeric:tabular-nums;min-width:50%}
caption{text-align:left;font-weight:600;font-size:14px;padding:4px 0 6px}
th,td{padding:3px 7px;text-align:right;white-space:nowrap;border-bottom:1px solid #eaeef2}
thead th{vertical-align:bottom;background:var(--pale);border-bottom:1px solid var(--rule);white-space:normal}
tbody th{font-weight:500}th[scope=colgroup]{text-align:center;border-left:1px solid var(--rule)}
tbody th,.name,table.left td,table.left th,thead th[rowspan]{text-align:left}
td.words{white-space:normal;min-width:200px}td.words:nth-child(3){min-width:290px}
tr.first th,tr.first td{border-top:1px solid #b4bdc8}tbody tr:hover{background:#fafbe8}
.badge{white-space:nowrap;padding:1px 7px;border-radius:9px;font-weight:600;font-size:12px}
.met{color:#0b5a2b;background:#e2f4e8}.missed{color:#93190f;background:#fde8e6}.unknown{color:#4b5563;background:#eceff3}
figure{margin:14px 0 24px}figcaption{font-size:13px;color:#3c4653;margin-top:4px}
.pair,.triple{display:grid;gap:10px 18px;grid-template-columns:repeat(2,minmax(0,1fr));align-items:start}
.triple{grid-template-columns:repeat(3,minmax(0,1fr))}
svg{display:block;width:100%;height:auto}svg svg{overflow:hidden}svg path{fill:none;stroke-linejoin:round}
svg text{font-size:11px;fill:#3c4653}svg .middle{text-anchor:middle}svg .end{text-anchor:end}
svg .halo{stroke:#fff;stroke-width:3px;paint-order:stroke;fill:#111}
.grid{stroke:#d9dfe6;stroke-width:.7}.frame{stroke:#8a95a3}path.limit{stroke:#111;stroke-dasharray:5 4;stroke-width:1.2}
svg .up{fill:#e9eff6}svg .box{fill:#d3ccc0;stroke:#8d8474;stroke-width:.8}
path.trunk{stroke:var(--trunk);stroke-width:1.3;stroke-dasharray:2 3}path.left{stroke:var(--left);stroke-width:1.7}
path.right{stroke:var(--right);stroke-width:1.7;stroke-dasharray:7 3}
path.target{stroke:var(--target);stroke-width:1.9}path.casing{stroke:var(--casing);stroke-width:2.8}
path.actual{stroke:var(--actual);stroke-width:1.6}path.target,path.casing,path.actual{stroke-dasharray:none}
path.target.right,path.casing.right,path.actual.right{stroke-dasharray:6 3}
.p0{stroke:#0072b2;color:#0072b2}.p1{stroke:#c2500a;color:#c2500a}.p2{stroke:#00785a;color:#00785a}
.p3{stroke:#a3457b;color:#a3457b}.p4{stroke:#5f5f00;color:#5f5f00}.p5{stroke:#333;color:#333}
svg .mark{fill:currentColor;stroke:#fff;stroke-width:.8}.bar{stroke-width:2}.course{stroke-width:1.5}
.key{display:inline-block;margin-right:8px;white-space:nowrap}
.sample{display:inline-block;width:12px;height:12px;vertical-align:-1px}
.line{display:inline-block;width:26px;height:0;border-top:2px solid;vertical-align:4px}
.line.trunk{border-top:2px dotted var(--trunk)}.line.left{border-color:var(--left)}
.line.right{border-top:2px dashed var(--right)}.line.limit{border-top:1px dashed #111}
.line.target{border-top:3px solid var(--target)}
.line.actual{height:5px;border:1px solid var(--casing);background:var(--actual);vertical-align:2px}
.ground{display:inline-block;width:22px;height:10px;background:#e9eff6;border:1px solid #b9c7d8}
@media screen and (max-width:760px){body{padding:10px 12px 32px;font-size:16px}
.pair,.triple{grid-template-columns:minmax(0,1fr)}.wide{overflow-x:auto}.wide>div{min-width:760px}
.key{white-space:normal}svg text{font-size:12px}}
@media print{@page{size:A4 landscape;margin:12mm}body{max-width:none;padding:0;font-size:11px}table{font-size:8.5px}
th,td{padding:2px 4px}nav{display:none}figure,tr,.badge{break-inside:avoid}h2,h3,h4,caption{break-after:avoid}
.wide svg[role]{width:75%}.scroll{overflow:visible}
details::details-content{content-visibility:visible;height:auto;display:block}
*{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
"""
