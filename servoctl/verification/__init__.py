"""Verification: runs against the full mechanism, closed loops against their repetition and their power balance."""

from servoctl.verification.result import Verification
from servoctl.verification.verify import verify

__all__ = ["Verification", "verify"]
