"""The work folder: what is stored, linked, leased and listed there."""
