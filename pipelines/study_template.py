"""The HTML of a study's page, a jinja2 template. Nothing is fetched from anywhere."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,"><title>{{ study.title }} - chebsplat</title>
<style>{{ style|safe }}
main { max-width: 1640px }
.wide td:first-child { position: sticky; left: 0; background: var(--paper) }
.wide td, .wide th { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums } .wide th { white-space: normal; min-width: 5em; vertical-align: bottom }
.wide .t { text-align: left }
.wide small { display: block; color: var(--soft) } .wide small.sure { color: var(--ink); font-weight: 700 }
.wide tr.base td { background: var(--back) } dl { display: grid; grid-template-columns: max-content 1fr; gap: .2em 1em } dt { color: var(--soft) } dd { margin: 0; overflow-wrap: anywhere }
.failed { border-left: 4px solid #d1242f }
</style></head><body><main>
<h1>{{ study.title }}</h1>
<p>{{ study.about }}</p>
<div class="card"><img src="{{ picture }}" alt="error against run time, a line a variant"></div>
<h2>The comparison</h2>
<p class="soft">{{ note }}</p>
<div class="card wide"><table><thead><tr>{% for cell in header %}<th{% if loop.index0 < labels|length %} class="t"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for is_base, row in table %}<tr{% if is_base %} class="base"{% endif %}>{% for value, change, sure in row %}<td{% if loop.index0 < labels|length %} class="t"{% endif %}>{{ value }}{% if change %}<small{% if sure %} class="sure"{% endif %}>{{ change }}</small>{% endif %}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% for section in more %}<h2>{{ section.heading }}</h2>
<p class="soft">{{ section.note }}</p>
{% if section.picture %}<div class="card"><img src="{{ pictures[section.picture] }}" alt="{{ section.heading }}"></div>{% endif %}
<div class="card wide"><table><thead><tr>{% for cell in section.table[0] %}<th{% if loop.index0 < 2 %} class="t"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for row in section.table[1:] %}<tr>{% for cell in row %}<td{% if loop.index0 < 2 %} class="t"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endfor %}{% if missing %}<h2>Runs without figures</h2>
<div class="card failed"><ul>{% for run, why in missing %}<li>{{ run }}: {{ why }}</li>{% endfor %}</ul></div>{% endif %}
<h2>Each scene</h2>
<p class="soft">Mean ± standard deviation over seeds.</p>
<div class="card wide"><table><thead><tr>{% for cell in scenes[0] %}<th{% if loop.index0 <= labels|length %} class="t"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for row in scenes[1:] %}<tr>{% for cell in row %}<td{% if loop.index0 <= labels|length %} class="t"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
<h2>Extreme cases</h2>
<div class="card wide">{% if stability %}<table><thead><tr><th class="t">part</th><th>cases</th><th>failed</th><th>largest error ÷ its tolerance</th></tr></thead><tbody>
{% for part, cases, bad, worst in stability %}<tr><td class="t">{{ part }}</td><td>{{ cases }}</td><td>{{ bad }}</td><td>{{ "%.2g"|format(worst) }}</td></tr>
{% endfor %}</tbody></table>{% else %}<p class="soft">`make stability` has not been run in this folder: no table.</p>{% endif %}</div>
<h2>Where it comes from</h2>
<div class="card"><dl>{% for what, value in facts %}<dt>{{ what }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
<p class="soft">One row a run: results.csv, beside this page.</p></div>
</main></body></html>
"""  # noqa: E501
