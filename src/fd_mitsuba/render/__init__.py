"""What Mitsuba traces and Dr.Jit differentiates. Importing it chooses the LLVM library, before Dr.Jit loads."""

import sys

from fd_mitsuba import mitsuba_api

if "drjit" not in sys.modules:
    mitsuba_api.choose_llvm()
