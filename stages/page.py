"""The report's HTML, a jinja2 template. Nothing is fetched from anywhere."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,"><title>{{ name }} - chebsplat</title>
<style>{{ style|safe }}
.times { display: flex; height: 22px; border-radius: 6px; overflow: hidden; margin-bottom: 10px } .times span { min-width: 1px }
</style></head><body><main>
<h1>{{ name }}</h1>
<p class="soft">{{ source.kind }} scene{% if source.seed is defined %}, preset {{ source.preset }}, seed {{ source.seed }}{% endif %}; protocol {{ protocol.name }}, split: {{ protocol.split }}{% if teacher %}; 2D teacher: <b>{{ teacher[0] }}</b>, {{ teacher[1] }}{% endif %}.
{% for note in source.notes or [] %}{{ note }} {% endfor %}</p>
{% include "viewer" %}
<div class="tiles">{% for value, label, aside in tiles %}<div class="card"><b>{{ value }}</b>{{ label }}<small>{{ aside }}</small></div>{% endfor %}</div>
<h2>Test views</h2>
{% include "sheet" %}
<p class="soft">Evenly spaced over the views that protocol {{ protocol.name }} evaluates ({{ protocol.split }}). Colour errors are shown four times as strong.</p>
{% if classes %}<h2>IoU by class</h2>
<div class="card">{% include "bars" %}<p class="soft">Blue: the scene, %. {% if teacher %}Orange mark, and in brackets: its 2D teacher on the same views. {% endif %}Classes that occur in neither truth nor prediction are not listed.</p></div>{% endif %}
<h2>Error against run time</h2>
<div class="card"><div class="curves">{% for curve in curves %}<div>{{ curve|safe }}</div>{% endfor %}</div>
<p class="soft">Seconds count training alone. The curves are measured on watched training views; test views are only touched at the end (the star).</p></div>
<h2>All figures on the test views</h2>
<div class="card wide"><table><thead><tr><th>figure</th><th class="n">scene</th><th class="n">2D teacher</th></tr></thead><tbody>
{% for label, scene, of_teacher in rows %}<tr><td>{{ label }}</td><td class="n" data-label="scene">{{ scene }}</td><td class="n" data-label="2D teacher">{{ of_teacher }}</td></tr>
{% endfor %}</tbody></table></div>
<h2>Left out, and why</h2>
<div class="card wide"><table><tbody>{% for what, why in left_out %}<tr><td>{{ what }}</td><td>{{ why }}</td></tr>
{% endfor %}</tbody></table></div>
<h2>Where it comes from</h2>
<div class="card wide"><div class="times">{% for stage, seconds, key, device, threads in stages %}<span title="{{ stage }}: {{ "%.1f"|format(seconds) }} s" style="flex: {{ seconds }}; background: hsl({{ loop.index0 * 40 }} 55% 60%)"></span>{% endfor %}</div>
<table><thead><tr><th>stage</th><th class="n">seconds</th><th>device</th><th class="n">threads</th><th>artifact</th></tr></thead><tbody>
{% for stage, seconds, key, device, threads in stages %}<tr><td class="stay"><i style="display: inline-block; width: .8em; height: .8em; background: hsl({{ loop.index0 * 40 }} 55% 60%)"></i> {{ stage }}</td><td class="n" data-label="seconds">{{ "%.1f"|format(seconds) }}</td><td data-label="device">{{ device }}</td><td class="n" data-label="threads">{{ threads }}</td><td data-label="artifact"><code>{{ key }}</code></td></tr>
{% endfor %}<tr><td><b>total</b></td><td class="n" data-label="seconds"><b>{{ "%.1f"|format(total) }}</b></td></tr></tbody></table>
<p class="soft">The total is of all stages before this page{% if "channels" in stages|map("first") %}; the channels are computed once for all scenes of one teacher{% endif %}.</p>
<p class="soft">{% if code %}Commit {{ code.commit[:10] }}{{ " with changes" if code.dirty }}. {% endif %}{% for package, version in versions %}{{ package }} {{ version }}{{ ", " if not loop.last else "." }}{% endfor %}</p>
<details><summary>Every setting</summary><pre>{{ settings }}</pre></details></div>
</main>{% include "script" %}</body></html>
"""  # noqa: E501
