"""A corpus of malformed inputs, made by code: each ends in a clear error, in bounded time and memory.

One module per kind of input; each has `cases()`, and CASES in `corpus.py` collects them. `make malformed` runs all of
them and prints the table of outcomes; `make test` runs a sample that differs from kind to kind.
"""
