"""Digests of what the package makes, so that code can move without its results moving.

``python -m tests.golden make`` writes ``golden.json``; ``python -m tests.golden compare`` makes
everything again and prints what differs.  With ``--quick`` only the part that every test run does.
"""

import os

# Sums of a linear-algebra library depend on the number of its threads.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"
