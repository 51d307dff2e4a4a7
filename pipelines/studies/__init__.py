"""Studies: the planning and running of many scenes (`study`), and what comes of them.

A run's figures are a `Row` with the COLUMNS of `results`; its scores lie in [0, 1], and tables show
them in per cent. `results` compares variants; `page` writes all, with `tables`, `figures` (charts)
and `pictures` (views of the scenes).
Imports: this package -> pipelines; of pipelines, only the command imports it.
"""
