"""Land where asked: planners through the surrogate, reinforcement learning, and the demo that runs the whole chain."""
