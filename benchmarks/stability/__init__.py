"""Every stiff and extreme case, through the naive formula and through ours."""
