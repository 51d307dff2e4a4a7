"""Studies: many scenes planned and run (`study`), and the figures, tables and pages of their runs.

A run's figures are a `Row` with the COLUMNS of `results`; its scores lie in [0, 1], and tables show
them in per cent. `results` compares variants; `page` writes all, with `tables`, `figures` (charts)
and `pictures` (views of the scenes).
Imports: this package -> pipelines; of pipelines, only the command imports it.
"""
