"""`python -m fd_mitsuba`."""

import sys

from fd_mitsuba.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
