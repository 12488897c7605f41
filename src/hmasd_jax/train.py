"""`python -m hmasd_jax.train COMMAND`: see `hmasd_jax.cli.main`."""

import atexit
import gc
import sys

from hmasd_jax.cli.main import main

if __name__ == "__main__":
    # Loading modules makes no garbage. Looking for it meanwhile, and once more at the end, takes a
    # fifth of the time of `train --help`.
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)
    sys.exit(main())
