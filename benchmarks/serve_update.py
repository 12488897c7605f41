"""Train one update for every line of standard input, and answer with its CPU-seconds.

python benchmarks/serve_update.py '{"env.name": "alice_and_bob", "algorithm.name": "hmasd"}'

The argument is a JSON object of settings by dotted name. The first line of the answer is the
CPU-seconds that it took to compile `init` and `update`. versions.py runs this file with the package
of some commit on PYTHONPATH, so it imports only what all commits have, and compiles with JAX's own
settings.
"""

import json
import sys
import time

import jax

from hmasd_jax import config as configs


def main() -> None:
    """Serve until standard input ends."""
    _, algorithm = configs.build(configs.load(overrides=json.loads(sys.argv[1])))
    start = time.process_time()
    state = jax.block_until_ready(jax.jit(algorithm.init)(jax.random.key(0)))
    update = jax.jit(algorithm.update).lower(state).compile()
    print(time.process_time() - start, flush=True)
    for _ in sys.stdin:
        start = time.process_time()
        jax.block_until_ready(update(state))
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
