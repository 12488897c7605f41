import jax
import jax.numpy as jnp

from hmasd_jax.rl.keys import key_beside


def test_a_key_beside_is_none_of_a_split_and_each_is_another():
    key = jax.random.key(3)
    beside = jnp.stack([jax.random.key_data(key_beside(key, number)) for number in range(3)])
    split = jax.random.key_data(jax.random.split(key, 64))
    all_keys = jnp.concatenate([beside, split])
    assert len(jnp.unique(all_keys, axis=0)) == len(all_keys)


def test_jax_splits_by_folding_in_small_numbers():
    # The reason for `key_beside`. If this fails, small numbers have become safe.
    key = jax.random.key(3)
    folded = jax.random.fold_in(key, 1)
    assert (jax.random.key_data(folded) == jax.random.key_data(jax.random.split(key, 6)[1])).all()
