"""Charges mirrored in the gates, beside the tables of the Poisson solver and measured a_ij."""
