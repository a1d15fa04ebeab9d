"""The version of servoctl."""

__version__ = "0.1.0"
