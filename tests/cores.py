"""Shares the cores among the processes that run tests; imported before torch, which counts its threads when it is."""

import os

JOBS = int(os.environ.get("TEST_JOBS", "1"))
"""Processes that run the tests, where they are forked."""
if JOBS > 1:
    # OpenMP's threads spin while they wait: two workers with a thread for every core each take many times as long.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // JOBS)))
