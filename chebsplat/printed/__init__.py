"""The paper's method as printed, in plain torch: one module a section, to be read beside the paper.

Where the print is silent or divides by zero, the function's docstring has the choice and the
reason. `training.printed` runs these modules, with the values that are open; nothing is tuned.
"""
