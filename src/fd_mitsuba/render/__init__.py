"""What Mitsuba traces and Dr.Jit differentiates. Importing it chooses the LLVM library, before Dr.Jit loads."""

import sys

from fd_mitsuba.backend import startup

if "drjit" not in sys.modules:
    startup.choose_llvm()
