"""Hop data and a learned stand-in for the simulator: generate, store, train, evaluate."""
