"""What the pages share, parts of jinja2 templates: style, a slider between two pictures, bars by class.

A page includes them by name: viewer and script want `modes`, `legend` and, on the page, sheet with its `pictures`;
bars wants `classes`. On a screen narrower than `narrow` pixels the rows of a table become cards, whose cells say by
`data-label` what they are: nothing is cut off, and nothing scrolls sideways.
"""

from typing import Any

STYLE = """
:root { --ink: #1c2430; --soft: #5b6675; --line: #dfe4ea; --paper: #fff; --back: #f4f6f8; --main: #1f6feb; --other: #b9c6d6 }
* { box-sizing: border-box }
body { font: 16px/1.55 system-ui, sans-serif; margin: 0; color: var(--ink); background: var(--back) }
main { max-width: 1180px; margin: 0 auto; padding: 20px 16px 60px }
h1 { font-size: clamp(1.5rem, 4vw, 2.1rem); margin: .2em 0 } h2 { font-size: 1.2rem; margin: 2em 0 .6em }
p { max-width: 76ch } .soft { color: var(--soft); font-size: .9rem }
.card { background: var(--paper); border: 1px solid var(--line); border-radius: 10px; padding: 14px }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(135px, 1fr)); gap: 10px; margin: 14px 0 }
.tiles b { display: block; font-size: 1.45rem; line-height: 1.25 } .tiles small { color: var(--soft); display: block }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: .92rem }
td, th { padding: .25em 1em .25em 0; text-align: left; vertical-align: top } td:first-child { min-width: 8.5em } th { color: var(--soft); font-weight: 600 }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
.stay { white-space: nowrap } .long { overflow-wrap: anywhere } tbody tr + tr td { border-top: 1px solid var(--line) }
code { font-size: .85em; overflow-wrap: anywhere } pre { font-size: .8rem; white-space: pre-wrap; overflow-wrap: anywhere }
img, svg { max-width: 100%; height: auto; display: block } [hidden] { display: none !important } summary { cursor: pointer }
.curves { display: grid; grid-template-columns: repeat(auto-fit, minmax(290px, 1fr)); gap: 12px }
.modes { display: flex; flex-wrap: wrap; gap: 6px; margin-bottom: 10px }
.modes button { font: inherit; font-size: .9rem; padding: .35em .8em; border: 1px solid var(--line); border-radius: 99px; background: var(--paper); color: var(--ink); cursor: pointer }
.modes button:disabled { opacity: .4; cursor: default } .modes .next { margin-left: auto }
.modes button[aria-pressed=true] { background: var(--ink); border-color: var(--ink); color: #fff }
.stage { position: relative; display: grid; overflow: hidden; max-width: 900px; margin: 0 auto; border-radius: 6px; background: #000; --at: 50% }
.stage > * { grid-area: 1 / 1; min-width: 0 } .side { display: grid } .side img { grid-area: 1 / 1; width: 100% }
.side .over { opacity: var(--strength, .65) } .side.left { clip-path: inset(0 calc(100% - var(--at)) 0 0) }
.stage::after { content: ""; grid-area: 1 / 1; width: 3px; margin-left: calc(var(--at) - 1.5px); background: #fff; box-shadow: 0 0 4px #000; pointer-events: none }
.stage output { align-self: end; z-index: 1; margin: 8px; padding: .1em .6em; border-radius: 4px; background: #000a; color: #fff; font-size: .8rem; pointer-events: none; max-width: 46% }
.stage output.right { justify-self: end } .stage output.left { justify-self: start }
.stage input { width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; touch-action: pan-y; z-index: 2 }
.stage:focus-within { outline: 3px solid var(--main) } .tools { display: flex; flex-wrap: wrap; gap: .4em 1.4em; align-items: center; margin-top: 8px; font-size: .9rem }
.legend { display: flex; flex-wrap: wrap; gap: .2em 1em; font-size: .88rem; margin-top: 8px }
.legend i { display: inline-block; width: .9em; height: .9em; margin-right: .35em; border-radius: 3px; vertical-align: -1px }
.sheet { display: grid; gap: 12px } .sheet > div { display: grid; grid-template-columns: repeat(auto-fit, minmax(104px, 1fr)); gap: 6px; cursor: pointer }
.sheet figure { margin: 0 } .sheet img { width: 100%; background: #ddd; border-radius: 4px } figcaption { font-size: .76rem; color: var(--soft); overflow-wrap: anywhere }
.classes { display: grid; grid-template-columns: max-content 1fr max-content; gap: .3em .8em; align-items: center; font-size: .9rem }
.bars { position: relative; height: 1.05em; background: var(--back); border-radius: 3px } .bars b, .bars u { position: absolute; left: 0; height: 100%; border-radius: 3px }
.bars b { background: var(--main) } .bars u { border-right: 3px solid #e36209; background: none } .n { font-variant-numeric: tabular-nums; text-align: right }
@media (max-width: NARROWpx) {
  .wide thead { display: none } .wide table, .wide tbody, .wide tr, .wide td { display: block }
  .wide tr { padding: .5em 0 } .wide tbody tr + tr { border-top: 1px solid var(--line) } .wide tbody tr + tr td { border: 0 }
  .wide table td { padding: 0; text-align: left; white-space: normal; overflow-wrap: anywhere } .wide td:empty { display: none }
  .wide table td:first-child { position: static; font-weight: 600 }
  .wide td[data-label]::before { content: attr(data-label) ": "; color: var(--soft); font-weight: 400 }
}
"""  # noqa: E501

VIEWER = """<div class="card viewer" hidden>
<div class="modes" role="group" aria-label="what to compare"></div>
<div class="stage"><div class="side right"><img class="base" alt=""><img class="over" alt=""></div><div class="side left"><img class="base" alt=""><img class="over" alt=""></div>
<output class="left"></output><output class="right"></output><input type="range" min="0" max="100" step="0.1" value="50" aria-label="slide between left and right"></div>
<div class="tools"><span class="which"></span>{% if legend %}<label>labels' strength <input type="range" class="strength" min="0" max="1" step="0.05" value="0.65"></label>{% endif %}</div>
{% if legend %}<div class="legend">{% for label, color in legend %}<span><i style="background: {{ color }}"></i>{{ label }}</span>{% endfor %}</div>{% endif %}
</div>"""  # noqa: E501

SHEET = """<div class="card sheet">{% for row in pictures %}<div data-name="{{ row.name }}">{% for key, uri, caption in row.images %}
<figure><img data-of="{{ key }}" src="{{ uri }}" alt="{{ caption }}"><figcaption>{{ caption }}</figcaption></figure>{% endfor %}</div>
{% endfor %}</div>"""  # noqa: E501

BARS = """<div class="classes">{% for label, color, value, other in classes %}<span><i style="display: inline-block; width: .7em; height: .7em; border-radius: 2px; background: {{ color }}"></i> {{ label }}</span>
<div class="bars"><b style="width: {{ (100 * value)|round(1) }}%"></b>{% if other is not none %}<u style="width: {{ (100 * other)|round(1) }}%"></u>{% endif %}</div><span class="n">{{ "%.1f"|format(100 * value) }}{% if other is not none %} <span class="soft">({{ "%.1f"|format(100 * other) }})</span>{% endif %}</span>
{% endfor %}</div>"""  # noqa: E501

SCRIPT = """<script>
const all = (where, what) => [...where.querySelectorAll(what)], viewer = document.querySelector(".viewer");
const modes = {{ modes|tojson }}; // [name, left, right]; a side is {caption, base, over}, the latter two naming pictures
const views = all(document, ".sheet > div").map(row => ({ row, name: row.dataset.name,
  src: Object.fromEntries(all(row, "img").map(image => [image.dataset.of, image.src])) }));
const fits = ([, ...sides]) => sides.every(s => [s.base, s.over].every(name => !name || name in view.src));
const photo = { caption: "photo", base: "truth" }, alone = ["", photo, photo]; // where nothing else is there
let view = views[0], mode = modes[0] ?? alone;
function show() {
  if (!fits(mode)) mode = modes.find(fits) ?? alone;
  for (const [where, chosen] of [["left", mode[1]], ["right", mode[2]]]) {
    const [base, over] = all(viewer, `.side.${where} img`);
    base.src = view.src[chosen.base]; base.alt = chosen.caption;
    over.hidden = !chosen.over; if (chosen.over) over.src = view.src[chosen.over];
    viewer.querySelector(`output.${where}`).textContent = chosen.caption;
  }
  viewer.querySelector(".which").textContent = `${view.name} (${views.indexOf(view) + 1} of ${views.length})`;
  buttons.forEach((button, k) => { button.setAttribute("aria-pressed", modes[k] == mode); button.disabled = !fits(modes[k]); });
}
function button(text, act) {
  const made = document.createElement("button");
  made.type = "button"; made.textContent = text; made.onclick = () => { act(); show(); };
  viewer.querySelector(".modes").append(made);
  return made;
}
const buttons = modes.map(m => button(m[0], () => mode = m));
if (views.length > 1) button("next view ›", () => view = views[(views.indexOf(view) + 1) % views.length]).className = "next";
views.forEach(v => v.row.onclick = () => { view = v; show(); viewer.scrollIntoView({ behavior: "smooth" }); });
viewer.querySelector(".stage input").oninput = event => viewer.querySelector(".stage").style.setProperty("--at", event.target.value + "%");
const strength = viewer.querySelector(".strength");
if (strength) strength.oninput = () => viewer.style.setProperty("--strength", strength.value);
viewer.hidden = false; show();
</script>"""  # noqa: E501


def rendered(page: str, narrow: int = 700, **values: Any) -> str:
    """A page of its template. Raises jinja2's UndefinedError for a value that it wants and is not given."""
    import jinja2

    parts = jinja2.DictLoader({"page": page, "viewer": VIEWER, "sheet": SHEET, "bars": BARS, "script": SCRIPT})
    environment = jinja2.Environment(loader=parts, autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.get_template("page").render(style=STYLE.replace("NARROW", str(narrow)), **values)
