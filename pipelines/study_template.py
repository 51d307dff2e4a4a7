"""The HTML of a study's page, a jinja2 template. Nothing is fetched from anywhere."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,"><title>{{ study.title }} - chebsplat</title>
<style>{{ style|safe }}
main { max-width: 1640px }
.wide td:first-child { min-width: 0; position: sticky; left: 0; background: var(--paper) }
.wide td, .wide th { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums } .wide th { white-space: normal; vertical-align: bottom }
.wide + .wide { margin-top: 12px }
.wide .t { text-align: left }
.wide small { display: block; color: var(--soft); white-space: normal } .wide small.sure { color: var(--ink); font-weight: 700 }
.wide tr.base td { background: var(--back) } dl { display: grid; grid-template-columns: max-content 1fr; gap: .2em 1em } dt { color: var(--soft) } dd { margin: 0; overflow-wrap: anywhere }
.wide td.w { text-align: left; white-space: normal; overflow-wrap: anywhere } .failed { border-left: 4px solid #d1242f }
</style></head><body><main>
<h1>{{ study.title }}</h1>
<p>{{ study.about }}</p>
{% if pictures %}{% include "viewer" %}
<p class="soft">The middle evaluated view of each scene{{ " (" + shown + ")" if shown }}: left of the line and right of it as the buttons say. All of them are further down.</p>{% endif %}
<h2>Error against {{ study.against or "run time" }}</h2>
<div class="card"><img src="{{ picture }}" alt="error against run time, a line a variant"></div>
<h2>The comparison</h2>
<p class="soft">{{ note }}</p>
{% for header, table in tables %}<div class="card wide"><table><thead><tr>{% for cell in header %}<th{% if loop.index0 < labels|length %} class="t"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for is_base, row in table %}<tr{% if is_base %} class="base"{% endif %}>{% for value, change, sure in row %}<td data-label="{{ header[loop.index0] }}"{% if loop.index0 < labels|length %} class="t"{% endif %}>{{ value }}{% if change %}<small{% if sure %} class="sure"{% endif %}>{{ change|replace(", ", ",\u00a0") }}</small>{% endif %}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endfor %}{% for section in more %}<h2>{{ section.heading }}</h2>
<p class="soft">{{ section.note }}</p>
{% if section.picture %}<div class="card"><img src="{{ drawings[section.picture] }}" alt="{{ section.heading }}"></div>{% endif %}
<div class="card wide"><table><thead><tr>{% for cell in section.table[0] %}<th{% if loop.index0 < 2 %} class="t"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for row in section.table[1:] %}<tr>{% for cell in row %}<td data-label="{{ section.table[0][loop.index0] }}"{% if loop.index0 < 2 %} class="t"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endfor %}{% if missing %}<h2>Runs without figures</h2>
<div class="card failed"><ul>{% for run, why in missing %}<li>{{ run }}: {{ why }}</li>{% endfor %}</ul></div>{% endif %}
{% if classes %}<h2>IoU by class</h2>
<div class="card">{% include "bars" %}<p class="soft">Blue: {{ compared }}, %, mean over scenes and seeds{{ " (" + shown.rsplit(", ", 1)[0] + ")" if ", " in shown }}.{% if compared != study.baseline %} Orange mark, and in brackets: {{ study.baseline }}.{% endif %}</p></div>{% endif %}
{% if scenes|length > 1 %}<h2>Each scene</h2>
<p class="soft">Mean ± standard deviation over seeds.</p>
<div class="card wide"><table><thead><tr>{% for cell in scenes[0] %}<th{% if loop.index0 <= labels|length %} class="t"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for row in scenes[1:] %}<tr>{% for cell in row %}<td data-label="{{ scenes[0][loop.index0] }}"{% if loop.index0 <= labels|length %} class="t"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>{% endif %}
{% if pictures %}<h2>Pictures</h2>
{% include "sheet" %}{% endif %}
<h2>Extreme cases</h2>
<div class="card wide">{% if stability %}<table><thead><tr><th class="t">part</th><th>cases</th><th>failed</th><th>largest error ÷ its tolerance</th></tr></thead><tbody>
{% for part, cases, bad, worst in stability %}<tr><td class="t">{{ part }}</td><td data-label="cases">{{ cases }}</td><td data-label="failed">{{ bad }}</td><td data-label="largest error ÷ its tolerance">{{ "%.2g"|format(worst) }}</td></tr>
{% endfor %}</tbody></table>{% else %}<p class="soft"><code>make stability</code> has not been run in this folder: no table.</p>{% endif %}</div>
{% if left_out %}<h2>Left out, and why</h2>
<div class="card wide"><table><thead><tr><th class="t">what</th><th class="t">why</th><th class="t">by</th></tr></thead><tbody>
{% for what, why, by in left_out %}<tr><td class="w">{{ what }}</td><td class="w">{{ why }}</td><td class="w" data-label="by">{{ by }}</td></tr>
{% endfor %}</tbody></table></div>{% endif %}
<h2>Where it comes from</h2>
<div class="card"><dl>{% for what, value in facts %}<dt>{{ what }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
<p class="soft">One row a run: results.csv, beside this page.</p></div>
</main>{% if pictures %}{% include "script" %}{% endif %}</body></html>
"""  # noqa: E501
