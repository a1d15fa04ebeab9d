"""`python -m servoctl` is `servoctl`."""

import sys

from servoctl.shell.main import main

if __name__ == "__main__":
    sys.exit(main())
