"""Train one update of HMASD for every line of standard input; answer with its CPU-seconds.

Run by versions.py with the package of some commit on PYTHONPATH, so it keeps to what all have. The
first line of the answer is what compiling `init` and `update` took.
"""

import sys
import time

import jax

import envs_jax
from hmasd_jax.hmasd import HMASDConfig, make_hmasd


def main() -> None:
    """Serve until standard input ends."""
    start = time.process_time()
    algorithm = make_hmasd(envs_jax.make(sys.argv[1]), HMASDConfig())
    state = jax.block_until_ready(jax.jit(algorithm.init)(jax.random.key(0)))
    update = jax.jit(algorithm.update).lower(state).compile()
    print(time.process_time() - start, flush=True)
    for _ in sys.stdin:
        start = time.process_time()
        jax.block_until_ready(update(state))
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
