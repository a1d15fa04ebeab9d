"""`python -m servoctl` is `servoctl`."""

import sys

from servoctl.cli import main

if __name__ == "__main__":
    sys.exit(main())
