"""The report's HTML, a jinja2 template."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>chebsplat: {{ name }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2em auto; padding: 0 1em; color: #1a202c }
h1 { font-size: 1.6em } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #e2e8f0 }
table { border-collapse: collapse } td, th { padding: .2em .9em .2em 0; text-align: left; vertical-align: top }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums }
.views { display: flex; gap: 6px; margin: 4px 0 14px } figure { margin: 0; flex: 1 } img { width: 100%; display: block }
figcaption { font-size: .8em; color: #4a5568 } .key { display: inline-block; margin-right: 1em }
.key i { display: inline-block; width: .9em; height: .9em; margin-right: .3em; vertical-align: -1px }
.bar { background: #2b6cb0; height: .7em } code { font-size: .9em } svg { max-width: 100%; height: auto }
</style></head><body>
<h1>{{ name }}</h1>
<p>Source: <b>{{ source.kind }}</b>{% if source.seed is defined %}, preset {{ source.preset }}, seed {{ source.seed }}{% endif %}.
Protocol <b>{{ protocol.name }}</b>, split: {{ protocol.split }}.
{% if teacher %}2D teacher: <b>{{ teacher[0] }}</b>, {{ teacher[1] }}.{% endif %}
{% for note in source.notes or [] %}{{ note }} {% endfor %}</p>
<h2>Figures on the test views</h2>
<table><tr><th>figure</th><th class="n">scene</th><th class="n">2D teacher</th></tr>
{% for label, scene, teacher in rows %}<tr><td>{{ label }}</td><td class="n">{{ scene }}</td><td class="n">{{ teacher }}</td></tr>
{% endfor %}</table>
<h2>Pictures</h2>
{% for row in pictures %}<div class="views">{% for label, uri in row.images %}
<figure><img src="{{ uri }}" alt="{{ label }}"><figcaption>{{ label }}{% if label == "renders" %} {{ "%.1f"|format(row.psnr) }} dB{% elif label == "truth" %} {{ row.name }}{% endif %}</figcaption></figure>{% endfor %}</div>
{% endfor %}<p>{% for label, color in legend %}<span class="key"><i style="background: {{ color }}"></i>{{ label }}</span>{% endfor %}</p>
<h2>Error against run time</h2>
{{ curve|safe }}
<p>Seconds count training alone; held-in views are training views, never test views.</p>
{% if segmentation %}<h2>IoU by class</h2>
<table><tr><th>class</th><th class="n">scene</th><th class="n">teacher</th><th style="width: 320px"></th></tr>
{% for label in segmentation.classes %}{% set value = segmentation.scene.iou[label] %}{% if value is not none %}<tr><td>{{ label }}</td>
<td class="n">{{ "%.1f"|format(100 * value) }}</td><td class="n">{% if segmentation.teacher is defined and segmentation.teacher.iou[label] is not none %}{{ "%.1f"|format(100 * segmentation.teacher.iou[label]) }}{% endif %}</td>
<td><div class="bar" style="width: {{ (100 * value)|round(1) }}%"></div></td></tr>{% endif %}
{% endfor %}</table>{% endif %}
<h2>Run time by stage</h2>
<table><tr><th>stage</th><th class="n">seconds</th><th>device</th><th class="n">threads</th><th>key</th></tr>
{% for stage, seconds, key, device, threads in stages %}<tr><td>{{ stage }}</td><td class="n">{{ "%.1f"|format(seconds) }}</td><td>{{ device }}</td><td class="n">{{ threads }}</td><td><code>{{ key }}</code></td></tr>
{% endfor %}<tr><td><b>total</b></td><td class="n"><b>{{ "%.1f"|format(total) }}</b></td></tr></table>
<h2>Left out, and why</h2>
<table>{% for what, why in left_out %}<tr><td>{{ what }}</td><td>{{ why }}</td></tr>
{% endfor %}</table>
<h2>Versions</h2>
<p>{% for package, version in versions %}{{ package }} {{ version }}{{ ", " if not loop.last }}{% endfor %}</p>
</body></html>
"""  # noqa: E501
