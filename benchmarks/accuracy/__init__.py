"""How accurate a hop is, how far one can be predicted at all, and where the methods stop working.

``python -m benchmarks.accuracy [--quick] [part ...]``; docs/accuracy.md explains what comes out.
"""
