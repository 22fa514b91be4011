"""Version of the package and of the physics."""

#: Package version.
__version__ = "0.1.0"

#: Version of the model: raised by whatever changes a landing. Data, checkpoints and results carry it.
MODEL_VERSION = "2"
