"""Malformed inputs as one table: what is damaged how, the command that meets it, its exit code,
words of its message.

`tests/whole/test_malformed.py` runs the whole table.
"""
