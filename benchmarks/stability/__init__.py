"""Every stiff and extreme case of the maths, each with its oracle."""
