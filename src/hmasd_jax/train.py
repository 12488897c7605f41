"""`python -m hmasd_jax.train COMMAND`: see `hmasd_jax.cli.main`."""

import sys

from hmasd_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
