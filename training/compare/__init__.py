"""Planners and policies compared at equal numbers of simulator calls, on targets fixed beforehand."""
