"""The frame of a page: markup, style and script. Marks between @@ are replaced by `compose`."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

PAGE: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline'; \
style-src 'unsafe-inline'; img-src data: blob:; font-src data:">
<title>@@TITLE@@ – @@KIND@@</title>
<style>@@STYLE@@</style>
</head>
<body>
<main>
<header>
<div><p class="kind">@@KIND@@</p><h1>@@TITLE@@</h1><p class="subtitle">@@SUBTITLE@@</p></div>
<p class="verdict @@VERDICT_CLASS@@">@@VERDICT@@</p>
</header>
<section class="thresholds">@@THRESHOLDS@@</section>
<section class="tiles">@@TILES@@</section>
<noscript><p>The figures need JavaScript. Nothing is loaded from the network.</p></noscript>
@@FIGURES@@
<div class="listings">@@TABLES@@</div>
</main>
<script>@@PLOTLY@@</script>
<script type="application/json" id="figures">@@DATA@@</script>
<script>@@SCRIPT@@</script>
</body>
</html>
"""

STYLE: Final = """
:root { --ink: #1d2939; --soft: #667085; --line: #e4e7ec; --good: #067647; --bad: #b42318; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7fa; color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 960px; margin: 0 auto; padding: 24px 16px 48px; }
header { display: flex; flex-wrap: wrap; gap: 8px 24px; align-items: flex-end; justify-content: space-between; }
h1 { font-size: 28px; line-height: 1.2; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 17px; margin: 0; }
h3 { font-size: 15px; margin: 0 0 6px; }
.kind { margin: 0; color: var(--soft); font-size: 13px; letter-spacing: .04em; text-transform: uppercase; }
.subtitle { margin: 4px 0 0; color: var(--soft); }
.subtitle b { color: var(--ink); font-weight: 600; }
.verdict { margin: 0; padding: 6px 14px; border-radius: 999px; font-weight: 600; color: white;
  overflow-wrap: anywhere; }
.verdict.passed { background: var(--good); }
.verdict.missed { background: var(--bad); border-radius: 14px; }
.thresholds { margin: 14px 0; }
.thresholds p { margin: 0; color: var(--soft); }
.missing { margin: 0 0 12px; padding: 10px 14px; border: 1px solid #f0c36d; border-radius: 10px; background: #fff8e6; }
.missing ul { margin: 4px 0 0; padding-left: 20px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(168px, 1fr)); gap: 10px; margin: 14px 0; }
.tile, .figure, .listing { background: white; border: 1px solid var(--line); border-radius: 10px; }
.tile { padding: 9px 12px; display: flex; flex-direction: column; }
.tile span, .tile small { color: var(--soft); font-size: 12.5px; }
.tile b { font-size: 18px; font-weight: 600; font-variant-numeric: tabular-nums; }
.figure { padding: 14px 14px 6px; margin: 14px 0; break-inside: avoid; }
.caption { margin: 2px 0 6px; color: var(--soft); font-size: 14px; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 380px), 1fr)); }
.plot { width: 100%; min-width: 0; }
.listings { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap: 14px;
  align-items: start; }
.listing { padding: 12px 14px; break-inside: avoid; overflow-x: auto; }
.listing p { margin: 0; color: var(--soft); }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; }
.listing table { width: 100%; }
th { text-align: left; font-weight: 600; color: var(--soft); white-space: nowrap; }
th, td { padding: 3px 14px 3px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
tr:last-child td { border-bottom: 0; }
tr.good td:last-child { color: var(--good); font-weight: 600; }
tr.bad td:last-child { color: var(--bad); font-weight: 600; }
@media (max-width: 520px) {
  main { padding: 14px 8px 32px; }
  .figure { padding: 12px 6px 4px; }
  .figure h2, .caption { padding: 0 6px; }
  .tiles { grid-template-columns: repeat(2, 1fr); gap: 8px; }
  h1 { font-size: 23px; }
  table { display: block; overflow-x: auto; font-size: 12.5px; }
  .listing table { display: table; }
  th, td { padding-right: 9px; }
}
@media print {
  @page { margin: 14mm; }
  body { background: white; font-size: 12px; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  main { max-width: none; padding: 0; }
  .tiles { grid-template-columns: repeat(4, 1fr); }
  .modebar { display: none !important; }
  .plots { display: flex; }
  .plots .plot { width: auto; }
}
"""

SCRIPT: Final = """
"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const touch = window.matchMedia("(pointer: coarse)").matches;
const config = { responsive: true, displaylogo: false, modeBarButtons: [["resetScale2d", "toImage"]],
  displayModeBar: window.matchMedia("(hover: hover)").matches ? "hover" : false };
const linked = figures.filter(figure => figure.layout.meta === "time").map(figure => figure.key);
const drawn = new Set();
let following = false;
// Zooming one time axis zooms all of them: what happened at the same time stands below one another.
function follow(source, change) {
  if (following) { return; }
  const range = change["xaxis.range"] || [change["xaxis.range[0]"], change["xaxis.range[1]"]];
  const whole = change["xaxis.autorange"] === true || change["autosize"] === true;
  if (!whole && (range[0] === undefined || range[1] === undefined)) { return; }
  following = true;
  const others = figures.filter(figure => linked.includes(figure.key) && figure.key !== source).map(figure => {
    const wanted = whole ? [...figure.home] : [...range];
    if (drawn.has(figure)) { return Plotly.relayout(figure.key, { "xaxis.range": wanted }); }
    figure.layout.xaxis.range = wanted;
  });
  Promise.all(others).finally(() => { following = false; });
}
function draw(figure) {
  if (drawn.has(figure)) { return; }
  drawn.add(figure);
  // On a touch screen a finger on a figure scrolls the page.
  figure.layout.dragmode = touch ? false : "zoom";
  const element = document.getElementById(figure.key);
  const eye = figure.layout.scene?.camera?.eye;
  if (eye) {  // the scene fills the height of its figure; where there is less width it is seen from further away
    const away = Math.min(1.9, Math.max(1.0, 1.25 * element.clientHeight / element.clientWidth));
    for (const axis of "xyz") { eye[axis] *= away; }
  }
  Plotly.newPlot(element, figure.data, figure.layout, config);
  if (linked.includes(figure.key)) {
    element.on("plotly_relayout", change => follow(figure.key, change));
  }
}
for (const figure of figures) {
  if (linked.includes(figure.key)) { figure.home = [...figure.layout.xaxis.range]; }
}
// What is on the screen, or nearly, is drawn first; the page can be read meanwhile.
const near = new IntersectionObserver(entries => entries.filter(entry => entry.isIntersecting).forEach(entry => {
  near.unobserve(entry.target);
  draw(figures.find(figure => figure.key === entry.target.id));
}), { rootMargin: "300px" });
figures.forEach(figure => near.observe(document.getElementById(figure.key)));
window.everythingDrawn = new Promise(done => {
  function next() {
    const figure = figures.find(figure => !drawn.has(figure));
    if (figure === undefined) { done(figures.length); return; }
    draw(figure);
    setTimeout(next, 30);
  }
  setTimeout(next, 400);
});
// Figures do not follow the paper by themselves. A page is 660 pixels wide and holds two figures of this height.
window.addEventListener("beforeprint", () => {
  figures.forEach(draw);
  for (const figure of figures) {
    const plot = document.getElementById(figure.key);
    const height = Math.min(plot.clientHeight, 370);
    plot.dataset.height = plot.style.height;
    plot.style.height = height + "px";
    Plotly.relayout(plot, { width: plot.parentElement.childElementCount > 1 ? 325 : 660, height });
  }
});
window.addEventListener("afterprint", () => {
  for (const figure of figures) {
    const plot = document.getElementById(figure.key);
    plot.style.height = plot.dataset.height;
    Plotly.relayout(plot, { width: null, height: null, autosize: true });
  }
});
"""


def compose(parts: Mapping[str, str], figures: Sequence[Mapping[str, Any]]) -> str:
    """The whole page.

    Args:
        parts: HTML for the marks KIND (left out: "Flight report"), TITLE, SUBTITLE, VERDICT, VERDICT_CLASS ("passed" or
            "missed"), THRESHOLDS, TILES, FIGURES (with an element for each figure's key) and TABLES.
        figures: what plotly.js draws: "key", "data" and "layout".
    """
    from plotly.offline import get_plotlyjs  # 3.6 MB of script

    # "</" would end the script element that holds the data.
    data = json.dumps(figures, default=_encode_array, allow_nan=False).replace("</", "<\\/")
    filled = {
        "KIND": "Flight report",
        **parts,
        "STYLE": STYLE,
        "PLOTLY": get_plotlyjs(),
        "DATA": data,
        "SCRIPT": SCRIPT,
    }
    # One pass over the template's own marks, so that nothing inside an inserted part is taken for a mark.
    pieces = PAGE.split("@@")
    return "".join(filled[piece] if index % 2 else piece for index, piece in enumerate(pieces))


def _encode_array(value: object) -> object:
    """Arrays as plotly.js takes them: base64 of the numbers, which also holds NaN."""
    if isinstance(value, np.ndarray):
        return {"dtype": "f4", "bdata": base64.b64encode(value.astype("<f4").tobytes()).decode("ascii")}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} does not belong into a figure")
