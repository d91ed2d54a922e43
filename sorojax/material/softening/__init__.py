"""Rubbers that soften by what they have borne, and their constants from cyclic tension."""
